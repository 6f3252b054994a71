"""The shape of a field: a hash grid of many resolutions (Müller et al. 2022) behind a small network, in whole numbers.

Every weight and activation is a whole number of small units, and every sum of a network stays below 2^53. So a product
of matrices has one result, exactly, in whatever order a library, a thread or a machine adds it up.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from gsstream.core.shapes import FloatArray, IntArray

#: Entries and activations are whole numbers of 2^-ENTRY_BITS below 2^ENTRY_RANGE; weights likewise. A layer adds up
#: at most 2^7 products, so its sums stay below 2^(26 + 18 + 7), which float64 holds exactly.
ENTRY_BITS, ENTRY_RANGE = 20, 26
WEIGHT_BITS, WEIGHT_RANGE = 14, 18
MAX_LEVELS, MAX_FEATURES, MAX_LAYERS, MAX_BASE, MAX_CELLS = 16, 8, 4, 1024, 1 << 20
#: Largest width of a layer: the number of features of all levels together.
MAX_INPUTS = MAX_LEVELS * MAX_FEATURES
#: Entries of all levels together, at most.
MAX_ENTRIES = 1 << 20
#: Outputs of the network at a position: a translation, and a quaternion minus (1, 0, 0, 0).
OUTPUTS = 7
#: Entries are drawn up to this far from 0, in their units: 10^-4.
START = 105
#: One prime for each axis; what a hash grid is usually hashed with.
PRIMES = (1, 2_654_435_761, 805_459_861)
#: Index of the network's first weight in the random stream; grid entries use smaller indices.
_WEIGHTS_FROM = 1 << 31
_CORNERS = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)])


@dataclass(frozen=True, slots=True)
class FieldShape:
    """What a field is made of, before anything is learned.

    Arguments:
        low, high: corners of its box, scene units, float32 numbers.
        reach: shift that a unit of the network's output stands for, scene units; a float32 above 0.
        levels: L, resolutions of the grid, 1 to 16.
        entries: log2 of the entries of a resolution, 1 to 20; all together 2^20 at most.
        features: F, numbers of an entry, 1 to 8.
        base: cells along an axis at the coarsest resolution, 1 to 1024.
        growth: ratio from one resolution to the next, a float32 from 1 to 4; at most 2^20 cells along an axis.
        width: neurons of a hidden layer, 1 to 128.
        layers: hidden layers, 1 to 4.
        seed: from which both ends draw the weights that learning starts from, 0 to 2^32 - 1.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    reach: float
    levels: int
    entries: int
    features: int
    base: int
    growth: float
    width: int
    layers: int
    seed: int = 0

    def problem(self) -> str | None:
        """Say why a field cannot have this shape; None when it can."""
        ranges = {
            "levels": MAX_LEVELS,
            "entries": 20,
            "features": MAX_FEATURES,
            "base": MAX_BASE,
            "width": MAX_INPUTS,
            "layers": MAX_LAYERS,
        }
        for name, most in ranges.items():
            if not 1 <= getattr(self, name) <= most:
                return f"{name}: expected 1 to {most}, got {getattr(self, name)}"
        if not 0 <= self.seed < 1 << 32:
            return f"seed: expected 0 to 2^32 - 1, got {self.seed}"
        for axis, (low, high) in enumerate(zip(self.low, self.high, strict=True)):
            if not (_is_float32(low) and _is_float32(high) and low < high):
                return f"box: expected float32 corners, the lower one first, got {low!r} and {high!r} on axis {axis}"
        if not (_is_float32(self.reach) and 0 < self.reach < 1e9):
            return f"reach: expected a float32 above 0 and below 1e9, got {self.reach!r}"
        if not (_is_float32(self.growth) and 1 <= self.growth <= 4):
            return f"growth: expected a float32 from 1 to 4, got {self.growth!r}"
        if self.levels << self.entries > MAX_ENTRIES:
            return f"entries: expected at most {MAX_ENTRIES} in all levels, got {self.levels << self.entries}"
        if self.cells[-1] > MAX_CELLS:
            return f"growth: expected at most {MAX_CELLS} cells along an axis, got {self.cells[-1]}"
        return None

    @property
    def cells(self) -> list[int]:
        """Cells along an axis at each resolution: the base times the growth, once for each level, rounded down."""
        ratio, out = 1.0, []
        for _ in range(self.levels):
            out.append(int(self.base * ratio))
            ratio *= self.growth
        return out

    @property
    def widths(self) -> list[int]:
        """Numbers before, between and behind the layers of the network."""
        return [self.levels * self.features, *[self.width] * self.layers, OUTPUTS]

    @property
    def flops(self) -> int:
        """Multiplications that a place takes."""
        widths = self.widths
        return 8 * widths[0] + sum(a * b for a, b in itertools.pairwise(widths))

    def unit(self, means: FloatArray) -> FloatArray:
        """Return centres [A, 3] in units of the box [A, 3], float64: 0 to 1 along each axis within it."""
        low, high = np.array(self.low), np.array(self.high)
        return np.asarray((means.astype(np.float64) - low) / (high - low))

    def corners(self, unit: FloatArray, level: int) -> tuple[IntArray, FloatArray]:
        """Return which entries of a level the places between its corners are interpolated from.

        Arguments:
            unit: [A, 3] places in units of the box, 0 to 1.
            level: of the grid.

        Returns:
            [8, A] int64 entries within the level, and [8, A] float64 weights, for the corners of a place's cell. A
            level that has room for all its corners stores each at a place of its own; another one where a hash says.
        """
        cells, size = self.cells[level], 1 << self.entries
        place = unit.T * float(cells)
        low = np.minimum(np.floor(place), float(cells - 1))
        part = place - low
        near = np.stack([1.0 - part, part])  # [2, 3, A]
        at = low.astype(np.int64) + np.arange(2)[:, None, None]
        dense = (cells + 1) ** 3 <= size
        x, y, z = _CORNERS.T
        if dense:
            index = (at[x, 0] * (cells + 1) + at[y, 1]) * (cells + 1) + at[z, 2]
        else:
            mixed = [at[:, axis] * prime for axis, prime in enumerate(PRIMES)]
            index = (mixed[0][x] ^ mixed[1][y] ^ mixed[2][z]) & (size - 1)
        return index, near[x, 0] * near[y, 1] * near[z, 2]

    def touched(self, unit: FloatArray) -> list[IntArray]:
        """Return for each level which of its entries these places [A, 3] are interpolated from, ascending."""
        out: list[IntArray] = []
        for level in range(self.levels):
            marks = np.zeros(1 << self.entries, bool)
            for start in range(0, len(unit), BLOCK):
                marks[self.corners(unit[start : start + BLOCK], level)[0].ravel()] = True
            out.append(np.flatnonzero(marks))
        return out

    def start_entries(self, level: int, entries: IntArray) -> IntArray:
        """Return the first values of some entries [E] of a level: [E, F] whole numbers of 2^-20."""
        first = ((level << self.entries) + entries) * self.features
        return _drawn(self.seed, first[:, None] + np.arange(self.features), START)

    def start_weights(self) -> list[IntArray]:
        """Return the weights that learning starts from: for each layer [inputs, outputs] whole numbers of 2^-14.

        The last layer is zero, so that nothing moves; the others are uniform, with variance 2 / inputs.
        """
        widths, first = self.widths, _WEIGHTS_FROM
        out: list[IntArray] = []
        for inner, outer in itertools.pairwise(widths):
            most = int((1 << WEIGHT_BITS) * math.sqrt(6.0 / inner)) if len(out) < self.layers else 0
            out.append(_drawn(self.seed, first + np.arange(inner * outer).reshape(inner, outer), most))
            first += inner * outer
        return out


#: Places that are looked up at a time: what a scene takes in memory does not grow with its size.
BLOCK = 1 << 13


def evaluate_network(
    shape: FieldShape, unit: FloatArray, touched: list[IntArray], entries: list[IntArray], weights: list[IntArray]
) -> FloatArray:
    """Return the outputs of the network at places ``unit`` [A, 3] in [0, 1]: [A, 7] float64, multiples of 2^-34.

    For each level, ``touched`` [E] are the entries that these places touch, ascending, and ``entries`` [E, F] their
    whole numbers of 2^-20; ``weights`` are, for each layer, [inputs, outputs] whole numbers of 2^-14.
    """
    ranks = np.zeros((shape.levels, 1 << shape.entries), np.int32)
    for rank, which in zip(ranks, touched, strict=True):
        rank[which] = np.arange(len(which))
    tables = [np.ascontiguousarray(table.T, np.float64) for table in entries]
    layers = [layer.astype(np.float64) for layer in weights]
    out = np.empty((len(unit), OUTPUTS))
    for start in range(0, len(unit), BLOCK):
        part = unit[start : start + BLOCK]
        values = np.empty((len(part), shape.levels * shape.features))
        for level, table in enumerate(tables):
            index, near = shape.corners(part, level)
            of = ranks[level].take(index)
            for feature, column in enumerate(table):
                values[:, level * shape.features + feature] = _rounded(_interpolated(column, of, near))
        for number, layer in enumerate(layers):
            # Exact, see above: whole numbers whose sums float64 holds, so no order of adding up matters.
            values = values @ layer
            if number < shape.layers:
                values = np.clip(_rounded(values * 2.0**-WEIGHT_BITS), 0.0, 2.0**ENTRY_RANGE - 1)
        out[start : start + BLOCK] = values * 2.0 ** -(ENTRY_BITS + WEIGHT_BITS)
    return out


def _interpolated(column: FloatArray, of: IntArray, near: FloatArray) -> FloatArray:
    """[A] float64 between the corners, added up corner by corner."""
    total = near[0] * column.take(of[0])
    for corner in range(1, 8):
        total += near[corner] * column.take(of[corner])
    return np.asarray(total)


def _rounded(values: FloatArray) -> FloatArray:
    """Round to the nearest whole numbers, halves upwards, in two steps that are exact in every language."""
    return np.asarray(np.floor(values + 0.5))


def _drawn(seed: int, number: IntArray, most: int) -> IntArray:
    """Whole numbers from -most to most, drawn by number: the same on every machine."""
    mixed = _mixed(np.asarray(number, np.uint64) + _mixed(np.array([seed], np.uint64)))
    return np.asarray(((mixed >> np.uint64(8)) * np.uint64(2 * most + 1)) >> np.uint64(24), np.int64) - most


def _mixed(value: IntArray) -> IntArray:
    """A 32-bit mix of 32-bit numbers (Wellons' lowbias32)."""
    low = np.uint64(0xFFFFFFFF)
    value = value & low
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        value = value ^ (value >> np.uint64(shift))
        value = (value * np.uint64(factor)) & low
    return np.asarray(value ^ (value >> np.uint64(16)))


def _is_float32(value: float) -> bool:
    return math.isfinite(value) and float(np.float32(value)) == value
