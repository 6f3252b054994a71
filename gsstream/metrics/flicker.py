"""Temporal flicker: how much a decoded picture changes from one frame to the next where nothing moves."""

from __future__ import annotations

import math

import numpy as np

from gsstream.core.shapes import FloatArray
from gsstream.metrics.moving import moving_mask
from gsstream.metrics.psnr import check_pair


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
