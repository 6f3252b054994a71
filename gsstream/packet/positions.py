"""Positions of a key packet: on a grid as fine as each Gaussian is small, coded as a cell and bits within it.

The step of a Gaussian follows from its decoded scales, which the reader has first; nothing is sent for it. Gaussians
are stored along a space-filling curve, so the cell of one predicts the next.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from gsstream.core.errors import PacketError, ShapeError
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.packet.bits import pack_blobs, unpack_blobs
from gsstream.packet.symbols import decode_symbols, encode_symbols

#: A step is at most 2^-FINENESS of the smallest axis of its Gaussian ...
FINENESS = 2
#: ... but no finer than 2^-(FINENESS + SLACK) of the scene's median middle axis: needles and pancakes get no more.
SLACK = 2
#: Bits of a position inside its cell, per axis.
MAX_DEPTH = 24
_MAX_EXPONENT = 60
_MAX_CELL = 1 << 29
_HEAD = struct.Struct("<bbb")
#: log2(e) in 2^-20: exponents come from integers alone.
_LOG2E = 1512775


class Grid(NamedTuple):
    """Step of Gaussian i: 2^max(floor, floor(log2 of its smallest axis) - fineness); cells of side 2^cell."""

    floor: int
    fineness: int
    cell: int


def quantise_positions(means: FloatArray, scale_codes: IntArray, bits: int) -> FloatArray:
    """Return [N, 3] float32 positions on their grids. Raises ShapeError when they are too far out for it."""
    if len(means) == 0:
        return np.zeros((0, 3), np.float32)
    exponents = step_exponents(scale_codes, bits, floor_exponent(scale_codes, bits), FINENESS)
    _check_range(means, int(exponents.min()))
    steps = 2.0 ** exponents[:, None]
    # + 0 makes -0 a +0. A float32 whose own spacing is coarser than the step is on the grid already.
    return np.asarray(np.rint(np.asarray(means, np.float64) / steps) * steps + 0.0, np.float32)


def encode_positions(means: FloatArray, scale_codes: IntArray, bits: int, floor: int | None = None) -> bytes:
    """Encode the codes that :func:`quantise_positions` returned; the reader knows N and the scales."""
    if len(means) == 0:
        return b""
    floor = floor_exponent(scale_codes, bits) if floor is None else floor
    exponents = step_exponents(scale_codes, bits, floor, FINENESS)
    wide = np.asarray(means, np.float64)
    best = min(_cell_candidates(wide, floor), key=lambda cell: _cost(wide, exponents, cell))
    cells = np.floor(wide / 2.0**best)
    depth = np.maximum(best - exponents, 0)
    local = ((wide - cells * 2.0**best) * 2.0 ** (depth - best)[:, None]).astype(np.int64)
    symbols = encode_symbols(np.diff(cells, axis=0, prepend=0).astype(np.int32))
    return _HEAD.pack(floor, FINENESS, best) + pack_blobs([symbols, _pack_local(local, depth)])


def decode_positions(data: bytes, scale_codes: IntArray, bits: int) -> FloatArray:
    """Decode the positions that :func:`encode_positions` wrote. Raises PacketError (without offset)."""
    number = len(scale_codes)
    if number == 0:
        if data:
            raise PacketError(f"{len(data)} bytes for no positions")
        return np.zeros((0, 3), np.float32)
    if len(data) < _HEAD.size:
        raise PacketError("means cut short")
    grid = Grid(*_HEAD.unpack_from(data))
    if max(abs(grid.floor), abs(grid.cell)) > _MAX_EXPONENT or not 0 <= grid.cell - grid.floor <= MAX_DEPTH:
        raise PacketError(f"means: cells of 2^{grid.cell} in steps of 2^{grid.floor} cannot be")
    symbols, local_bytes = unpack_blobs(data[_HEAD.size :], 2)
    cells = np.cumsum(decode_symbols(symbols, number, 3), axis=0, dtype=np.int64)
    if int(np.abs(cells).max()) > _MAX_CELL:
        raise PacketError("means: a cell is out of range")
    depth = np.maximum(grid.cell - step_exponents(scale_codes, bits, grid.floor, grid.fineness), 0)
    local = _unpack_local(local_bytes, depth)
    # In float64 first: both parts and their sum are exact there, and in float32 for what an encoder writes.
    return np.asarray((cells + local * 2.0 ** -depth[:, None]) * 2.0**grid.cell, np.float32)


def step_exponents(scale_codes: IntArray, bits: int, floor: int, fineness: int) -> IntArray:
    """Return [N] int64: log2 of each Gaussian's step."""
    exponents = (scale_codes.min(1).astype(np.int64) * _LOG2E >> (20 + bits)) - fineness
    return np.asarray(np.maximum(exponents, floor))


def floor_exponent(scale_codes: IntArray, bits: int) -> int:
    """Return log2 of the finest step of a scene.

    It depends on the decoded scales alone, so it survives quantisation.
    """
    middle = np.sort(scale_codes, axis=1)[:, 1]
    median = int(np.partition(middle, (len(middle) - 1) // 2)[(len(middle) - 1) // 2])
    exponent = (median * _LOG2E >> (20 + bits)) - FINENESS - SLACK
    return int(np.clip(exponent, -_MAX_EXPONENT, _MAX_EXPONENT - MAX_DEPTH))


def _check_range(means: FloatArray, floor: int) -> None:
    largest = float(np.abs(means).max())
    if largest >= _MAX_CELL * 2.0 ** (floor + MAX_DEPTH):
        raise ShapeError(
            f"means: expected coordinates below {_MAX_CELL * 2.0 ** (floor + MAX_DEPTH):g} in a scene of Gaussians "
            f"this small, got {largest:g}; the optimisation has diverged"
        )


def _cell_candidates(means: FloatArray, floor: int) -> range:
    largest = float(np.abs(means).max())
    least = max(floor, int(np.frexp(largest)[1]) - 29) if largest else floor
    return range(least, max(min(least + 14, floor + MAX_DEPTH), least) + 1)


def _cost(means: FloatArray, exponents: IntArray, cell: int) -> float:
    """Estimated bits with cells of 2^cell."""
    total = 3.0 * float(np.maximum(cell - exponents, 0).sum())
    moves = np.diff(np.floor(means / 2.0**cell), axis=0)
    for axis in moves.T:
        _, counts = np.unique(axis, return_counts=True)
        total += float((counts * np.log2(len(axis) / counts)).sum()) + 6 * len(counts)
    return total


def _pack_local(local: IntArray, depth: IntArray) -> bytes:
    stream = np.zeros(3 * int(depth.sum()), np.uint8)
    for bit, rows, where in _bit_places(depth):
        stream[where] = local[rows] >> (depth[rows, None] - 1 - bit) & 1
    return np.packbits(stream).tobytes()


def _unpack_local(data: bytes, depth: IntArray) -> IntArray:
    total = 3 * int(depth.sum())
    if len(data) != (total + 7) // 8:
        raise PacketError(f"means: expected {(total + 7) // 8} bytes of positions in cells, got {len(data)}")
    stream = np.unpackbits(np.frombuffer(data, np.uint8))
    if stream[total:].any():
        raise PacketError("means: padding after the last position is not zero")
    local = np.zeros((len(depth), 3), np.int64)
    for _, rows, where in _bit_places(depth):
        local[rows] = local[rows] << 1 | stream[where]
    return local


def _bit_places(depth: IntArray) -> Iterator[tuple[int, IntArray, IntArray]]:
    """From the highest bit down: its number, the rows that have it, and where it lies [rows, 3] in the bit stream.

    Bit by bit, so that memory stays at a few values per Gaussian however deep the cells are.
    """
    start = np.cumsum(3 * depth) - 3 * depth
    for bit in range(int(depth.max())):
        rows = np.flatnonzero(depth > bit)
        yield bit, rows, start[rows, None] + np.arange(3) * depth[rows, None] + bit
