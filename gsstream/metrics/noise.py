"""Camera noise, measured between two frames in which unknown regions moved."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from gsstream.core.median import median
from gsstream.core.shapes import FloatArray
from gsstream.metrics.picture_quality import check_pair

#: Standard deviation of a normal variable over its median absolute deviation.
MAD_TO_SIGMA = 1.4826


def median_deviation(values: FloatArray) -> np.floating[Any]:
    """Return the median absolute deviation from the median, in the precision of ``values``."""
    difference = values - median(values)
    return median(np.abs(difference, out=difference))


def noise_sigma(first: FloatArray, second: FloatArray) -> float:
    """Return the standard deviation of one camera's noise in one image, [0, 1] units.

    MAD of the differences around their median times 1.4826, divided by sqrt 2; fewer than half of the pixels may move.
    Images of 8 bits give a coarse answer (steps of about 1/255), and 0 where most pixels do not change at all.
    """
    check_pair(first, second)
    difference = np.asarray(second, np.float32) - np.asarray(first, np.float32)
    return float(MAD_TO_SIGMA * median_deviation(difference) / math.sqrt(2))
