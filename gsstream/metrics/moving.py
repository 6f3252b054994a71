"""Moving and changed pixels: where a view differs from how it began, and a method that freezes the scene loses."""

from __future__ import annotations

import math

import numpy as np

from gsstream.core.shapes import FloatArray
from gsstream.metrics.picture_quality import Mask, check_pair, psnr

#: Least difference that counts as motion, [0, 1] units, and the width of the rim added around it, pixels.
FLOOR, DILATION = 6 / 255, 2
#: Least difference of a changed pixel, [0, 1] units.
CHANGED = 0.1


def moving_mask(image: FloatArray, first: FloatArray, sigma: float) -> Mask:
    """Return [H, W] bool: pixels that differ from frame 0 beyond noise, dilated by 2 pixels.

    Some channel differs by more than max(4 sigma_d, 6/255).
    """
    check_pair(image, first)
    threshold = max(4 * math.sqrt(2) * sigma, FLOOR)
    return dilate(_differs(image, first, threshold), DILATION)


def changed_mask(image: FloatArray, first: FloatArray) -> Mask:
    """Return [H, W] bool: some channel differs from frame 0 by more than 0.1; the bodies, without shadows and rims."""
    check_pair(image, first)
    return _differs(image, first, CHANGED)


def _differs(image: FloatArray, first: FloatArray, threshold: float) -> Mask:
    """[H, W] bool: some channel differs by more than the threshold."""
    difference: FloatArray = np.subtract(image, first, dtype=np.float64)
    np.abs(difference, out=difference)
    return np.asarray(np.any(difference > threshold, axis=-1))


def dilate(mask: Mask, radius: int) -> Mask:
    """Grow a [H, W] mask by a square of (2 radius + 1)^2 pixels."""
    out = mask.copy()
    for _ in range(radius):
        grown = out.copy()
        grown[1:] |= out[:-1]
        grown[:-1] |= out[1:]
        wide = grown.copy()
        wide[:, 1:] |= grown[:, :-1]
        wide[:, :-1] |= grown[:, 1:]
        out = wide
    return out


def psnr_moving(image: FloatArray, target: FloatArray, first: FloatArray, sigma: float) -> float:
    """Return the PSNR on the moving pixels of ``target``; nan where nothing moves."""
    return psnr(image, target, moving_mask(target, first, sigma))


def flicker(
    image: FloatArray, last_image: FloatArray, truth: FloatArray, last_truth: FloatArray, sigma: float
) -> float:
    """Return the mean absolute change of still pixels between two decoded frames, in levels of 8 bits.

    Still are pixels whose ground truth does not differ between the frames beyond the camera's noise (as in
    ``moving_mask``). Only decoded pictures are subtracted, so 0 means a calm picture, right or wrong; nan: everything
    moves.
    """
    check_pair(image, last_image)
    check_pair(image, truth)
    still = ~moving_mask(truth, last_truth, sigma)
    change = np.abs(np.asarray(image, np.float64) - last_image)[still]
    return 255 * float(change.mean()) if change.size else math.nan
