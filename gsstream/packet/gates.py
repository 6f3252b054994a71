"""Gates as alternating runs of closed and open nodes: the cost grows with the number of changes of mind, not with M."""

from __future__ import annotations

import numpy as np

from gsstream.core.errors import PacketError, ShapeError
from gsstream.core.shapes import IntArray
from gsstream.packet.bits import BitReader, BitWriter, pack_blobs, unpack_blobs
from gsstream.packet.symbols import decode_symbols, encode_symbols

#: Run lengths below this have a token of their own; longer ones share tokens by magnitude and send the rest as bits.
_DIRECT = 16
_DIRECT_BITS = 4


def encode_gates(gates: IntArray, num_levels: int) -> bytes:
    """Encode [M] gate levels 0..num_levels; the reader knows M. Inverse: :func:`decode_gates`."""
    if not 1 <= num_levels <= 255:
        raise ShapeError(f"num_levels: expected 1 to 255, got {num_levels}")
    if gates.ndim != 1 or (gates.size and not 0 <= int(gates.min()) <= int(gates.max()) <= num_levels):
        raise ShapeError(f"gates: expected [M] levels from 0 to {num_levels}, got shape {list(gates.shape)}")
    opened, runs = gates != 0, _runs(gates)
    head = BitWriter()
    head.gamma(num_levels - 1)
    head.gamma(len(runs))
    head.bits(int(opened[0]) if len(gates) else 0, 1)
    blobs = []
    for part in _split(runs[:-1]):
        tokens, extra, widths = _tokens(part - 1)
        blobs.append(encode_symbols(tokens[:, None]))
        for value, width in zip(extra.tolist(), widths.tolist(), strict=True):
            head.bits(value, width)
    levels = gates[opened].astype(np.int32)[:, None] if num_levels > 1 else np.zeros((0, 1), np.int32)
    return pack_blobs([head.to_bytes(), *blobs, encode_symbols(levels)])


def decode_gates(data: bytes, num_nodes: int) -> tuple[IntArray, int]:
    """Decode gates [num_nodes] uint8 and num_levels. Raises PacketError (without offset)."""
    head_bytes, *blobs, level_bytes = unpack_blobs(data, 4)
    head = BitReader(head_bytes)
    num_levels, number, first = head.gamma() + 1, head.gamma(), head.bits(1)
    if num_levels > 255 or number > num_nodes or (number == 0) != (num_nodes == 0):
        raise PacketError(f"gates: {num_levels} levels in {number} runs over {num_nodes} nodes cannot be")
    runs = np.zeros(number, np.int64)
    for parity, blob in enumerate(blobs):
        part = runs[:-1][parity::2]
        part[:] = _lengths(decode_symbols(blob, len(part), 1)[:, 0], head) + 1
    head.finish()
    if number:
        runs[-1] = num_nodes - int(runs[:-1].sum())
        if runs[-1] < 1:
            raise PacketError(f"gate runs cover more than the {num_nodes} nodes of the scene")
    opened = np.repeat((np.arange(number) + first) % 2, runs).astype(bool)
    gates = opened.astype(np.uint8)
    count = int(opened.sum()) if num_levels > 1 else 0
    levels = decode_symbols(level_bytes, count, 1)[:, 0]
    if count:
        if int(levels.min()) < 1 or int(levels.max()) > num_levels:
            raise PacketError(f"gate level outside 1 to {num_levels}")
        gates[opened] = levels
    return gates, num_levels


def run_tokens(gates: IntArray) -> tuple[list[IntArray], int]:
    """Return the two token tables [., 1] of :func:`encode_gates`, and the number of bits sent beside them."""
    coded = [_tokens(part - 1) for part in _split(_runs(gates)[:-1])]
    return [tokens[:, None] for tokens, _, _ in coded], sum(int(widths.sum()) for _, _, widths in coded)


def _runs(gates: IntArray) -> IntArray:
    """Lengths of the alternating runs of closed and open nodes."""
    opened = gates != 0
    edges = np.flatnonzero(opened[1:] != opened[:-1]) + 1
    return np.diff(np.concatenate([[0], edges, [len(gates)]])) if len(gates) else np.zeros(0, np.int64)


def _split(runs: IntArray) -> tuple[IntArray, IntArray]:
    """Runs of the first kind and of the other kind: they have different statistics. The last run follows from M."""
    return runs[0::2], runs[1::2]


def _tokens(values: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Token, remaining bits and their number for each value >= 0."""
    values = values.astype(np.int64)
    length = np.floor(np.log2(np.maximum(values, 1))).astype(np.int64)  # exact: values stay below 2**24
    large = values >= _DIRECT
    second = (values >> np.maximum(length - 1, 0)) & 1
    token = np.where(large, _DIRECT + 2 * (length - _DIRECT_BITS) + second, values)
    width = np.where(large, length - 1, 0)
    extra = np.where(large, values & ((1 << np.maximum(length - 1, 0)) - 1), 0)
    return token.astype(np.int32), extra, width


def _lengths(tokens: IntArray, head: BitReader) -> IntArray:
    if len(tokens) and not 0 <= int(tokens.min()) <= int(tokens.max()) < _DIRECT + 2 * 28:
        raise PacketError("run-length token out of range")
    values = tokens.astype(np.int64)
    for row in np.flatnonzero(tokens >= _DIRECT).tolist():
        length, second = divmod(int(tokens[row]) - _DIRECT, 2)
        length += _DIRECT_BITS
        values[row] = 1 << length | second << (length - 1) | head.bits(length - 1)
    return values
