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

    Still are pixels whose ground truth does not differ between the two frames beyond the camera's noise (the rule of
    ``moving_mask``, applied to consecutive frames). The recording's own noise is not part of it: only decoded pictures
    are subtracted, so 0 means a perfectly calm picture, whether right or wrong.

    Returns nan where everything moves. Raises ShapeError when shapes disagree.
    """
    check_pair(image, last_image)
    check_pair(image, truth)
    still = ~moving_mask(truth, last_truth, sigma)
    change = np.abs(np.asarray(image, np.float64) - last_image)[still]
    return 255 * float(change.mean()) if change.size else math.nan
