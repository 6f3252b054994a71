"""Means over small blocks of pixels and what their noise is, in numpy: the blocks that ``gsstream.backend`` finds."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsstream.api import FloatArray
from gsstream.backend import ChangeRule, median

#: Rows that are subtracted at a time, a multiple of the side of a block.
_BAND = 64


def changed_blocks(before: Any, now: Any, threshold: float) -> NDArray[np.bool_]:
    """Return [ceil(H / 4), ceil(W / 4)] bool: blocks whose mean difference exceeds the noise of block means.

    Arguments:
        before, now: [H, W, 3] float32, or uint8 of which 255 is 1.0.
        threshold: multiple of the noise.
    """
    means = difference_means(before, now)
    marked = np.abs(means) > threshold * block_sigma(means)
    return np.asarray(marked[..., 0] | marked[..., 1] | marked[..., 2])


def difference_means(before: Any, now: Any) -> FloatArray:
    """Return the block means of ``now - before``, band by band of rows: a whole difference would leave the cache."""
    bands = (slice(top, top + _BAND) for top in range(0, len(now), _BAND))
    return np.concatenate([block_means(_difference(before[band], now[band])) for band in bands])


def _difference(before: Any, now: Any) -> Any:
    """[H, W, 3] float32, or int16 in levels of 8 bits where both images are stored as bytes."""
    if before.dtype == now.dtype == np.uint8:
        return np.subtract(now, before, dtype=np.int16)
    return floats(now) - floats(before)


def floats(image: Any) -> FloatArray:
    """Return a stored image as float32, of which 255 of a byte is 1.0."""
    if image.dtype == np.uint8:
        return np.asarray(np.divide(image, np.float32(255), dtype=np.float32))
    return np.asarray(image, np.float32)


def _median_deviation(values: FloatArray) -> Any:
    difference = values - median(values)
    return median(np.abs(difference, out=difference))


def block_sigma(means: FloatArray) -> float:
    """Return the noise of block means of a difference, image units, within its bounds."""
    # Where most are this small no median has to be found: their deviation from it is at most twice as large.
    small = ChangeRule.LEAST_SIGMA / (2 * ChangeRule.MAD_TO_SIGMA) * (1 - 1e-9)
    if 2 * np.count_nonzero(np.abs(means) < small) > means.size:
        return ChangeRule.LEAST_SIGMA
    spread = ChangeRule.MAD_TO_SIGMA * float(_median_deviation(means))
    if spread <= ChangeRule.LEAST_SIGMA:  # then it does not matter what second differences admit
        return ChangeRule.LEAST_SIGMA
    return min(max(_at_most_rough(spread, means), ChangeRule.LEAST_SIGMA), ChangeRule.MOST_SIGMA)


def block_means(picture: Any) -> FloatArray:
    """Return [ceil(H / 4), ceil(W / 4), 3] means of [H, W, 3]; blocks at the border average the pixels they have.

    Of int16 the sums are exact (they stay below 2^12), and a level is 1 / 255.
    """
    sums = _sums(_sums(picture).swapaxes(0, 1)).swapaxes(0, 1)
    if sums.dtype == np.int16:
        sums = np.divide(sums, 255.0)
    if not any(n % ChangeRule.BLOCK for n in picture.shape[:2]):
        return np.asarray(np.multiply(sums, 1 / ChangeRule.BLOCK**2, dtype=np.float64))
    sizes = [np.minimum(ChangeRule.BLOCK, n - np.arange(0, n, ChangeRule.BLOCK)) for n in picture.shape[:2]]
    return np.asarray(sums / np.outer(*sizes)[..., None])


def _sums(rows: Any) -> Any:
    """Sums over the rows of a block each; the last block may have fewer. A fifth of the time of ``np.add.reduceat``."""
    whole = len(rows) // ChangeRule.BLOCK * ChangeRule.BLOCK
    first, second, third, fourth = (rows[i : whole : ChangeRule.BLOCK] for i in range(ChangeRule.BLOCK))
    # The order in which reduceat adds, so that streams keep their bits.
    sums = first + (second + third + fourth)
    if whole == len(rows):
        return sums
    return np.concatenate([sums, rows[whole] + rows[whole + 1 :].sum(0, keepdims=True, dtype=rows.dtype)])


def _at_most_rough(spread: float, means: FloatArray) -> float:
    """The lesser of ``spread`` and of the noise that second differences of blocks along rows and columns admit."""
    rows, columns, channels = means.shape
    along, across = max(rows - 2, 0) * columns * channels, rows * max(columns - 2, 0) * channels
    if along + across == 0:  # a picture too small
        return spread
    values = np.empty(along + across, means.dtype)
    if along:
        _second_differences(means[:-2], means[1:-1], means[2:], values[:along].reshape(rows - 2, columns, channels))
    if across:
        out = values[along:].reshape(rows, columns - 2, channels)
        _second_differences(means[:, :-2], means[:, 1:-1], means[:, 2:], out)
    # The variance of a - 2 b + c is six times that of each.
    admitted = ChangeRule.MOST_OF_ROUGHNESS * ChangeRule.MAD_TO_SIGMA / np.sqrt(6)
    # Usually the bound is above the spread, and counting alone shows that; the margin is for rounding.
    if np.count_nonzero(values < spread / admitted * (1 + 1e-9)) < len(values) // 2:
        return spread
    return min(spread, float(ChangeRule.MOST_OF_ROUGHNESS * ChangeRule.MAD_TO_SIGMA * median(values) / np.sqrt(6)))


def _second_differences(first: FloatArray, second: FloatArray, third: FloatArray, out: FloatArray) -> None:
    """Write |first - 2 second + third| to ``out``."""
    np.multiply(second, 2, out=out)
    np.subtract(first, out, out=out)
    np.add(out, third, out=out)
    np.abs(out, out=out)
