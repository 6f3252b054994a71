"""Rounding by the price of a bit: each value takes the code with the least squared error plus weight times bits.

Video encoders call it rate-distortion optimised quantisation. Among the codes near a value some occur more often than
others, and cost fewer bits; where the images are hardly sensitive to the value, one of those does as well. A player
does not know of it: the format is the same.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gsstream.core.shapes import FloatArray, IntArray

#: How often the bits of a code are estimated from what was chosen. The third time changes next to nothing.
ROUNDS = 3
#: Count that stands for 0 where a code does not occur, so that its number of bits is finite.
UNUSED = 0.05
#: [N] nearest codes -> [K, N] codes to choose from.
_Near = Callable[[IntArray], IntArray]


def rd_codes_to_zero(exact: FloatArray, sensitivity: FloatArray, weight: float) -> IntArray:
    """Return the codes [N, width] int32 with the least ``sensitivity (code - exact)^2 + weight bits``, by column.

    The codes that each value may take: the nearest, its two neighbours towards zero, and zero. The bits of a code are
    those of a coder that knows how often each one occurs in its column.
    """

    def candidate_codes(nearest: IntArray) -> IntArray:
        towards = np.sign(nearest)
        # A code of 1 has no neighbour two steps towards zero on its own side of zero.
        second = np.where(np.abs(nearest) > 1, nearest - 2 * towards, 0)
        return np.stack([nearest, nearest - towards, second, np.zeros_like(nearest)])

    return _by_column(exact, sensitivity, weight, candidate_codes)


def rd_codes_nearby(exact: FloatArray, sensitivity: FloatArray, weight: float, reach: int) -> IntArray:
    """Return the best code within ``reach`` of the nearest code, for values that may change only a little."""
    # The nearest one first, then by distance: of equally good ones the nearer is taken.
    offsets = sorted(range(-reach, reach + 1), key=lambda offset: (abs(offset), offset))

    def candidate_codes(nearest: IntArray) -> IntArray:
        return np.stack([nearest + np.int32(offset) for offset in offsets])

    return _by_column(exact, sensitivity, weight, candidate_codes)


def _by_column(exact: FloatArray, sensitivity: FloatArray, weight: float, candidate_codes: _Near) -> IntArray:
    nearest = np.rint(exact).astype(np.int32)
    if weight == 0 or nearest.size == 0:
        return nearest
    columns = zip(exact.T, nearest.T, sensitivity.T, strict=True)
    return np.stack(
        [
            _column(values, codes, candidate_codes(codes), sensitivity=sensitivities, weight=weight)
            for values, codes, sensitivities in columns
        ],
        1,
    )


def _column(
    exact: FloatArray, nearest: IntArray, candidates: IntArray, sensitivity: FloatArray, weight: float
) -> IntArray:
    error = sensitivity * (candidates - exact) ** 2
    low = int(candidates.min())
    chosen = nearest
    for _ in range(ROUNDS):
        counts = np.bincount(chosen - low, minlength=int(candidates.max()) - low + 1) + UNUSED
        bits = -np.log2(counts / counts.sum())
        best = np.argmin(error + weight * bits[candidates - low], 0)
        chosen = candidates[best, np.arange(len(best))]
    return chosen
