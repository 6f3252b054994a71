"""Peak signal-to-noise ratio of images in [0, 1]."""

from __future__ import annotations

import math

import numpy as np

from gsstream.core.errors import ShapeError
from gsstream.core.shapes import FloatArray

Mask = np.ndarray[tuple[int, ...], np.dtype[np.bool_]]


def psnr(image: FloatArray, target: FloatArray, mask: Mask | None = None) -> float:
    """Return -10 log10 of the mean squared error of one image, dB; inf for equal ones, nan for an empty mask."""
    check_pair(image, target)
    error: FloatArray = np.subtract(image, target, dtype=np.float64)
    np.square(error, out=error)
    if mask is not None:
        if mask.shape != error.shape[:2]:
            raise ShapeError(f"mask: expected {list(error.shape[:2])}, got {list(mask.shape)}")
        error = error[mask]
    if error.size == 0:
        return math.nan
    mean = float(error.mean())
    return math.inf if mean == 0 else -10 * math.log10(mean)


def check_pair(image: FloatArray, target: FloatArray) -> None:
    """Raise ShapeError unless both are [H, W, 3] of one size."""
    if image.shape != target.shape or image.ndim != 3 or image.shape[2] != 3:
        raise ShapeError(f"expected two [H, W, 3] images of one size, got {list(image.shape)} and {list(target.shape)}")
