"""Means over blocks, against numpy's own sums over ranges: to the bit, because thresholds are compared with them."""

from __future__ import annotations

import numpy as np
import pytest

from gsstream.engine.still.blocks import BLOCK, block_means


@pytest.mark.parametrize("height", [1, 3, 4, 5, 8, 11, 240])
@pytest.mark.parametrize("width", [1, 2, 4, 7, 12, 317])
def test_blocks_at_the_border_average_the_pixels_they_have(height: int, width: int) -> None:
    picture = np.random.default_rng(height).normal(size=(height, width, 3)).astype(np.float32)
    starts = np.arange(0, height, BLOCK), np.arange(0, width, BLOCK)
    sums = np.add.reduceat(np.add.reduceat(picture, starts[0], 0), starts[1], 1)
    sizes = [np.minimum(BLOCK, n - s) for n, s in zip((height, width), starts, strict=True)]
    np.testing.assert_array_equal(block_means(picture), sums / np.outer(*sizes)[..., None])
