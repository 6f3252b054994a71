"""What the benchmarks measure: the kernel object of the module does what its arguments say."""

from __future__ import annotations

import numpy as np
import pytest
from cpu_scenes import HEIGHT, WIDTH, camera, random_splats, upstream
from gsstream_cpu_render.bench import Kernel

#: One tile of 16 x 16 pixels of 4 x 3.
MASK = np.zeros((3, 4), bool)
MASK[1, 2] = True


@pytest.mark.parametrize("incremental", [False, True])
def test_a_masked_kernel_draws_its_tiles_and_no_others(incremental: bool) -> None:
    splats = random_splats(200, 0, 4)
    active = np.arange(0, 200, 3) if incremental else None
    kernels = [
        Kernel(tuple(splats), *camera(), WIDTH, HEIGHT, 0.01, mask, active, upstream(0)[0]) for mask in (None, MASK)
    ]
    (image, *_), (masked, *_) = (kernel.forward() for kernel in kernels)
    pairs, few = (kernel.statistics()["pairs"] for kernel in kernels)
    assert 0 < few < pairs / 2
    masked = np.array(masked)
    np.testing.assert_array_equal(masked[16:32, 32:48], np.array(image)[16:32, 32:48])
    elsewhere = np.ones((HEIGHT, WIDTH), bool)
    elsewhere[16:32, 32:48] = False
    assert not masked[elsewhere].any(), "black is the background, and nothing else was drawn there"
    assert np.array(image)[elsewhere].any()
