"""Structural similarity, the variant of the Gaussian-splatting papers."""

from __future__ import annotations

import numpy as np

from gsstream.core.shapes import FloatArray
from gsstream.metrics.psnr import check_pair

#: Printed in every table: SSIM variants differ by up to 0.02.
SSIM_VARIANT = "SSIM 11x11 Gaussian 1.5, zero padding, mean over channels (3DGS)"
_RADIUS, _SIGMA, _C1, _C2 = 5, 1.5, 0.01**2, 0.03**2


def ssim(image: FloatArray, target: FloatArray) -> float:
    """Mean SSIM of two [H, W, 3] images in [0, 1] (Wang et al. 2004; window and zero padding as in 3DGS, Kerbl 2023).

    Computed in float64. Raises ShapeError when shapes disagree.
    """
    check_pair(image, target)
    x, y = np.asarray(image, np.float64), np.asarray(target, np.float64)
    mean_x, mean_y, square_x, square_y, product = (_blur(v) for v in (x, y, x * x, y * y, x * y))
    var_x, var_y, cov = square_x - mean_x**2, square_y - mean_y**2, product - mean_x * mean_y
    value = (2 * mean_x * mean_y + _C1) * (2 * cov + _C2)
    value /= (mean_x**2 + mean_y**2 + _C1) * (var_x + var_y + _C2)
    return float(value.mean())


def _blur(image: FloatArray) -> FloatArray:
    taps = np.exp(-(np.arange(_RADIUS + 1) ** 2) / (2 * _SIGMA**2))
    taps /= taps[0] + 2 * taps[1:].sum()
    for axis in (0, 1):
        padding = [(0, 0)] * 3
        padding[axis] = (_RADIUS, _RADIUS)
        wide, size = np.pad(image, padding), image.shape[axis]
        out = taps[0] * image
        for i in range(1, _RADIUS + 1):
            pair = _window(wide, axis, _RADIUS - i, size) + _window(wide, axis, _RADIUS + i, size)
            pair *= taps[i]
            out += pair
        image = out
    return image


def _window(image: FloatArray, axis: int, start: int, size: int) -> FloatArray:
    return image[start : start + size] if axis == 0 else image[:, start : start + size]
