"""Entropy coding of integer tables: one histogram model per channel (or one for all), ANS by constriction.

The model is sent as integer counts, rounded to three significant bits, and both ends build it from those integers, so
no float of one machine has to equal a float of another. Values far outside the bulk leave the table by an escape.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import constriction
import numpy as np

from gsstream.core.errors import PacketError
from gsstream.core.shapes import IntArray
from gsstream.packet.bits import BitReader, BitWriter, pack_blobs, unpack_blobs

# The extension module offers attributes, not importable submodules.
Categorical = constriction.stream.model.Categorical
AnsCoder = constriction.stream.stack.AnsCoder

#: Largest number of histogram bins of one channel.
MAX_BINS = 1 << 14
_INT32 = 1 << 31


@dataclass(frozen=True, slots=True)
class Model:
    """Histogram of one channel: bins [low, low + bins), and if ``escapes`` one more bin for everything outside.

    ``counts`` are the rounded counts, the escape last.
    """

    low: int
    counts: IntArray
    escapes: bool

    @property
    def bins(self) -> int:
        return len(self.counts) - self.escapes

    @property
    def constant(self) -> bool:
        """A channel of one value costs no bits."""
        return len(self.counts) == 1


def encode_symbols(symbols: IntArray) -> bytes:
    """Encode [A, L] int32. The reader must know A and L. Inverse: :func:`decode_symbols`."""
    if symbols.size == 0:
        return b""
    columns = [np.ascontiguousarray(symbols[:, i], np.int64) for i in range(symbols.shape[1])]
    own = [_fit(column) for column in columns]
    pooled = _fit(np.concatenate(columns)) if len(columns) > 1 else own[0]
    shared = len(columns) > 1 and sum(map(_cost, own, columns)) > (
        sum(_cost(pooled, c, header=False) for c in columns) + _header_cost(pooled)
    )
    models = [pooled] if shared else own
    head = BitWriter()
    head.bits(int(shared), 1)
    for model in models:
        _write_model(head, model)
    coder = AnsCoder()
    tails: list[BitWriter] = []
    for column, model in reversed(list(zip(columns, models * len(columns) if shared else models, strict=True))):
        index, tail = _index(column, model)
        tails.append(tail)
        if not model.constant:
            coder.encode_reverse(index.astype(np.int32), Categorical(model.counts.astype(np.float64), perfect=False))
    for tail in reversed(tails):
        head.extend(tail)
    words: bytes = coder.get_compressed().astype("<u4").tobytes()
    return pack_blobs([head.to_bytes(), words])


def decode_symbols(data: bytes, rows: int, channels: int) -> IntArray:
    """Decode [rows, channels] int32. Raises PacketError (without offset) when the bytes are not such a table."""
    out = np.empty((rows, channels), np.int32)
    if out.size == 0:
        if data:
            raise PacketError(f"{len(data)} bytes for an empty table")
        return out
    head_bytes, words = unpack_blobs(data, 2)
    head = BitReader(head_bytes)
    shared = bool(head.bits(1))
    models = [_read_model(head)] * channels if shared else [_read_model(head) for _ in range(channels)]
    if len(words) % 4:
        raise PacketError(f"entropy-coded words: expected a multiple of 4 bytes, got {len(words)}")
    try:
        coder = AnsCoder(np.frombuffer(words, "<u4").astype(np.uint32))
    except ValueError as error:
        raise PacketError(f"entropy-coded words are not a valid stream: {error}") from error
    for channel, model in enumerate(models):
        if model.constant:
            index = np.zeros(rows, np.int32)
        else:
            index = coder.decode(Categorical(model.counts.astype(np.float64), perfect=False), rows)
        out[:, channel] = _values(index, model, head)
    head.finish()
    if not coder.is_empty():
        raise PacketError("entropy-coded words are left over after the last symbol")
    return out


def _fit(column: IntArray) -> Model:
    values, counts = _histogram(column)
    first, last = _trim(values, counts)
    low, high = int(values[first]), int(values[last])
    table = np.zeros(high - low + 1, np.int64)
    table[values[first : last + 1] - low] = counts[first : last + 1]
    outside = int(len(column) - table.sum())
    if outside:
        table = np.append(table, outside)
    return Model(low, _round_counts(table), outside > 0)


def _histogram(column: IntArray) -> tuple[IntArray, IntArray]:
    """Values that occur, ascending, and how often each does: ``np.unique``, without sorting where values are near."""
    low, high = int(column.min()), int(column.max())
    if high - low > len(column) + MAX_BINS:
        return np.unique(column, return_counts=True)
    counts = np.bincount(column - low)
    values = np.flatnonzero(counts)
    return values + low, counts[values]


def _trim(values: IntArray, counts: IntArray) -> tuple[int, int]:
    """Drop rare values at the ends when the empty bins before them cost more header bits than escaping them."""
    first, last = 0, len(values) - 1
    total = int(counts.sum())
    middle = int(np.searchsorted(np.cumsum(counts), (total + 1) // 2))
    while first < middle and _cheaper_outside(int(values[first + 1] - values[first]), int(counts[first]), total):
        first += 1
    while last > middle and _cheaper_outside(int(values[last] - values[last - 1]), int(counts[last]), total):
        last -= 1
    if int(values[last] - values[first]) >= MAX_BINS:
        low = max(int(values[first]), int(values[middle]) - MAX_BINS // 2)
        first = int(np.searchsorted(values, low))
        last = int(np.searchsorted(values, low + MAX_BINS)) - 1
    return first, last


def _cheaper_outside(gap: int, count: int, total: int) -> bool:
    return gap > count * (2 * math.log2(gap + 1) + 2 + math.log2(total / count)) + 8


def _round_counts(counts: IntArray) -> IntArray:
    lengths = np.ceil(np.log2(counts + 1.0)).astype(np.int64)  # bit lengths; exact below 2**24
    shift = np.maximum(lengths - 3, 0)
    half = np.where(shift > 0, 1 << np.maximum(shift - 1, 0), 0)
    return np.asarray(((counts >> shift) << shift) + half)


def _write_model(head: BitWriter, model: Model) -> None:
    head.signed(model.low)
    head.gamma(model.bins - 1)
    head.bits(int(model.escapes), 1)
    if model.constant:
        return
    counts = model.counts.tolist()
    head.digits("".join(map(_count_code, [0, *counts], counts)))


@lru_cache(1 << 14)
def _count_code(before: int, count: int) -> str:
    """The bits of a rounded count after another one; few pairs are different, and every frame has them often."""
    field, length = BitWriter(), count.bit_length()
    field.signed(length - before.bit_length())
    if length > 1:
        width = min(length - 1, 2)
        field.bits(count >> (length - 1 - width) & ((1 << width) - 1), width)
    return str(field)


def _read_model(head: BitReader) -> Model:
    low, bins, escapes = head.signed(), head.gamma() + 1, bool(head.bits(1))
    if bins > MAX_BINS or not -_INT32 <= low <= _INT32 - bins:
        raise PacketError(f"histogram of {bins} bins from {low}: expected at most {MAX_BINS} within 32 bits")
    counts: IntArray = np.ones(1, np.int64)
    if bins + escapes > 1:
        counts = _read_counts(head, bins + escapes)
        if not counts.any():
            raise PacketError("histogram without any count")
    return Model(low, counts, escapes)


def _read_counts(head: BitReader, number: int) -> IntArray:
    counts, length = np.zeros(number, np.int64), 0
    for i in range(number):
        length += head.signed()
        if not 0 <= length <= 32:
            raise PacketError(f"histogram count of {length} bits: expected 0 to 32")
        if length:
            width = min(length - 1, 2)
            top = 1 << width | head.bits(width)
            shift = length - 1 - width
            counts[i] = (top << shift) + (1 << (shift - 1) if shift else 0)
    return counts


def _index(column: IntArray, model: Model) -> tuple[IntArray, BitWriter]:
    """Bin of every value, and the escaped values as bits."""
    index = column - model.low
    if not model.escapes:  # then the model has a bin for each of them
        return index, BitWriter()
    outside = (index < 0) | (index >= model.bins)
    tail = BitWriter()
    for value in index[outside].tolist():
        tail.bits(int(value < 0), 1)
        tail.gamma(-value - 1 if value < 0 else value - model.bins)
    return np.where(outside, model.bins, index), tail


def _values(index: IntArray, model: Model, head: BitReader) -> IntArray:
    values = index.astype(np.int64) + model.low
    if model.escapes:
        for row in np.flatnonzero(index == model.bins).tolist():
            below = head.bits(1)
            distance = head.gamma()
            value = model.low - 1 - distance if below else model.low + model.bins + distance
            if not -_INT32 <= value < _INT32:
                raise PacketError(f"escaped symbol {value} does not fit 32 bits")
            values[row] = value
    return values


def _cost(model: Model, column: IntArray, header: bool = True) -> float:
    """Estimated bits of a channel under a model."""
    index, tail = _index(column, model)
    used = np.bincount(index, minlength=len(model.counts))
    share = model.counts / model.counts.sum()
    seen = used > 0
    payload = -float((used[seen] * np.log2(np.maximum(share[seen], 2.0**-24))).sum())
    return payload + len(tail) + (_header_cost(model) if header else 0)


def _header_cost(model: Model) -> int:
    head = BitWriter()
    _write_model(head, model)
    return len(head)
