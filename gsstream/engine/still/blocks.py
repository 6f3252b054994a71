"""Means over small blocks of pixels, in which noise averages out and a change does not; and what their noise is."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsstream.core.shapes import FloatArray
from gsstream.metrics.noise import MAD_TO_SIGMA, median_deviation

BoolArray = np.ndarray[Any, np.dtype[np.bool_]]
#: Differences are averaged over BLOCK x BLOCK pixels first: noise of neighbouring pixels is mostly independent and
#: averages out (rendered noise is heavy-tailed, so a threshold on single pixels finds it everywhere), motion does not.
BLOCK = 4
#: Lower bound on the estimated noise of a block's mean difference. Compressed video repeats still blocks exactly;
#: without a floor the change of half a grey level by the encoder would count as motion.
LEAST_SIGMA = 0.5 / 255
#: Upper bound on the same estimate. The estimate holds while fewer than half of the blocks
#: move; a flash or a cut moves all of them, and then the change itself would pass for noise and nothing would be seen
#: to change. Recordings have about 1 / 255.
MOST_SIGMA = 4 / 255
#: Upper bound on the same estimate, in multiples of the differences between neighbouring blocks. Noise differs from
#: block to block, a slow change of the light hardly does: at a gain of 1.03 the spread of the differences doubles,
#: their second differences grow by 5 %. Without such a change the first is at most 1.2 times the second on the
#: recordings at hand.
MOST_OF_ROUGHNESS = 1.5


def changed_blocks(difference: FloatArray, threshold: float) -> BoolArray:
    """Return [ceil(H / 4), ceil(W / 4)] bool: blocks whose mean difference exceeds the noise of block means.

    Arguments:
        difference: [H, W, 3] of two pictures of one camera, image units.
        threshold: multiple of the robust spread of the block means.
    """
    means = block_means(difference)
    sigma = min(max(min(MAD_TO_SIGMA * float(median_deviation(means)), _rough(means)), LEAST_SIGMA), MOST_SIGMA)
    return np.asarray((np.abs(means) > threshold * sigma).any(-1))


def block_means(picture: FloatArray) -> FloatArray:
    """Return [ceil(H / 4), ceil(W / 4), 3] means of [H, W, 3]; blocks at the border average the pixels they have."""
    sizes = [np.minimum(BLOCK, n - np.arange(0, n, BLOCK)) for n in picture.shape[:2]]
    sums = _sums(_sums(picture).swapaxes(0, 1)).swapaxes(0, 1)
    return np.asarray(sums / np.outer(*sizes)[..., None])


def _sums(rows: FloatArray) -> FloatArray:
    """Sums over BLOCK rows each; the last block may have fewer. A fifth of the time of ``np.add.reduceat``."""
    whole = len(rows) // BLOCK * BLOCK
    first, second, third, fourth = (rows[i:whole:BLOCK] for i in range(BLOCK))
    # The order in which reduceat adds, so that streams keep their bits.
    sums = first + (second + third + fourth)
    return sums if whole == len(rows) else np.concatenate([sums, rows[whole] + rows[whole + 1 :].sum(0, keepdims=True)])


def _rough(means: FloatArray) -> float:
    """Most noise of a block that its second differences along rows and columns admit; inf in a picture too small."""
    second = [means[:-2] - 2 * means[1:-1] + means[2:], means[:, :-2] - 2 * means[:, 1:-1] + means[:, 2:]]
    values = np.abs(np.concatenate([part.ravel() for part in second]))
    if not values.size:
        return np.inf
    # The variance of a - 2 b + c is six times that of each.
    return float(MOST_OF_ROUGHNESS * MAD_TO_SIGMA * np.median(values) / np.sqrt(6))
