"""Which attributes of a sent row change: one number a row, so that zero rows of an attribute cost no symbols.

About half of the rows behind open gates change nothing, and of the others few change in all attributes. The number of
a row holds all of that at once, and its histogram what the attributes have in common.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gsstream.core.errors import PacketError
from gsstream.core.shapes import IntArray
from gsstream.packet.symbols import decode_symbols, encode_symbols


def pattern_of(symbols: Mapping[str, IntArray], names: list[str]) -> IntArray:
    """Return [A] int32: bit i of a row is set where attribute ``names[i]`` has a symbol that is not zero."""
    out = np.zeros(len(symbols[names[0]]), np.int32)
    for bit, name in enumerate(names):
        out |= symbols[name].any(1).astype(np.int32) << bit
    return out


def encode_pattern(pattern: IntArray) -> bytes:
    """Encode the numbers [A] of :func:`pattern_of`; the reader must know A."""
    return encode_symbols(pattern[:, None])


def decode_pattern(data: bytes, rows: int, attributes: int) -> IntArray:
    """Decode the numbers [rows] of :func:`pattern_of`.

    Raises PacketError (without offset) for a number beyond them, or where no attribute is sent.
    """
    if attributes == 0:
        raise PacketError("pattern of rows without an attribute that changes")
    pattern = decode_symbols(data, rows, 1)[:, 0]
    if pattern.size and (int(pattern.min()) < 0 or int(pattern.max()) >= 1 << attributes):
        raise PacketError(f"pattern of a row: expected 0 to {(1 << attributes) - 1} for {attributes} attributes")
    return pattern


def spread(table: IntArray, pattern: IntArray, bit: int) -> IntArray:
    """Return [A, L]: the rows of a table at the rows of the pattern that have the bit; zeros elsewhere."""
    out = np.zeros((len(pattern), table.shape[1]), np.int32)
    out[(pattern >> bit & 1) != 0] = table
    return out
