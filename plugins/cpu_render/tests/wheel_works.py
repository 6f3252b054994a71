"""Render with an installed wheel, on every instruction set of this processor; exit code 0 when all agree.

No pytest: it runs wherever the wheel is installed, also beside the player alone, which has no torch.
"""

from __future__ import annotations

import numpy as np
from gsstream_cpu_render import _native
from gsstream_cpu_render.rasterizer import render_numpy

from gsstream.player.software import render_numpy as reference


def main() -> None:
    """Draw one scene with every instruction set and with numpy alone. Raises AssertionError where they differ."""
    rng = np.random.default_rng(0)
    number, size = 500, (64, 48)
    scene = (
        rng.uniform(-1, 1, (number, 3)),
        rng.normal(size=(number, 4)),
        rng.uniform(-4, -2, (number, 3)),
        rng.normal(size=number),
        rng.normal(size=(number, 1, 3)),
        rng.normal(size=(number, 8, 3)) * 0.1,
    )
    viewmat = np.eye(4, dtype=np.float32)
    viewmat[2, 3] = 4
    intrinsics = np.array([[60, 0, 32], [0, 60, 24], [0, 0, 1]], np.float32)
    arguments = ([array.astype(np.float32) for array in scene], viewmat, intrinsics, *size, (0.1, 0.2, 0.3))
    expected = reference(*arguments, near=0.01)
    for isa in _native.supported_isas():
        _native.select_isa(isa)
        image = render_numpy(*arguments, near=0.01)
        worst = float(np.abs(image - expected).max())
        assert image.shape == (size[1], size[0], 3), image.shape
        assert worst < 1e-4, f"{isa}: differs from numpy by {worst}"
        print(f"{isa}: differs from numpy by at most {worst:.1e}")


if __name__ == "__main__":
    main()
