"""Bytes of chapter 2 of docs/spec, also such as no encoder here writes: any model, any run, any length."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from gsstream.packet.bits import BitWriter

TOTAL = 1 << 24


class Model(NamedTuple):
    """A histogram from ``low`` on; with ``escape`` the last count is that of all other values."""

    low: int
    counts: Sequence[int]
    escape: bool = False


def bits(*fields: tuple[str, int] | tuple[str, int, int]) -> bytes:
    """Return a byte string of fields ("gamma", v), ("signed", v) or ("bits", v, width)."""
    writer = BitWriter()
    for kind, *values in fields:
        getattr(writer, kind)(*values)
    return writer.to_bytes()


def leb128(value: int, length: int = 0) -> bytes:
    """Return a length in LEB128 of at least ``length`` bytes."""
    out = bytearray()
    while value or not out or len(out) < length:
        out.append(value & 127 | 128)
        value >>= 7
    out[-1] &= 127
    return bytes(out)


def parts(*some: bytes, length: int = 0) -> bytes:
    """Join byte strings, each but the last behind its length of at least ``length`` bytes."""
    return b"".join(leb128(len(part), length) + part for part in some[:-1]) + some[-1]


def table(columns: Sequence[Sequence[int]], models: Sequence[Model], shared: bool = False) -> bytes:
    """Return symbols with models that are chosen freely: one for each column, or the first for all."""
    return parts(head(columns, models, shared), words(columns, _each(models, len(columns), shared)))


def _each(models: Sequence[Model], columns: int, shared: bool) -> list[Model]:
    """The model of each column."""
    return [models[0]] * columns if shared else list(models)


def head(columns: Sequence[Sequence[int]], models: Sequence[Model], shared: bool = False) -> bytes:
    """Return the head of a table: models, then escaped values."""
    out = BitWriter()
    out.bits(int(shared), 1)
    for model in models[: 1 if shared else None]:
        write_model(out, model)
    for column, model in zip(columns, _each(models, len(columns), shared), strict=True):
        for value in column:
            if model.escape and not 0 <= value - model.low < len(model.counts) - 1:
                above = value >= model.low
                out.bits(int(not above), 1)
                out.gamma(value - model.low - len(model.counts) + 1 if above else model.low - 1 - value)
    return out.to_bytes()


def write_model(out: BitWriter, model: Model) -> None:
    """Write low, bins, escape and counts."""
    out.signed(model.low)
    out.gamma(len(model.counts) - model.escape - 1)
    out.bits(int(model.escape), 1)
    if len(model.counts) == 1:
        return
    before = 0
    for count in model.counts:
        length = count.bit_length()
        out.signed(length - before)
        if length > 1:
            sent = min(length - 1, 2)
            out.bits(count >> (length - 1 - sent) & ((1 << sent) - 1), sent)
        before = length


def middle(count: int) -> int:
    """Return the count that a reader takes for this one."""
    rest = max(count.bit_length() - 3, 0)
    return (count >> rest << rest) + ((1 << rest) >> 1)


def intervals(counts: Sequence[int]) -> list[int]:
    """Return the left ends of section 2.5, and 2^24."""
    known = [middle(count) for count in counts]
    scale = (TOTAL - len(known)) / sum(known)
    before, left = 0, []
    for i, count in enumerate(known):
        left.append(int(before * scale) + i)
        before += count
    return [*left, TOTAL]


def words(columns: Sequence[Sequence[int]], models: Sequence[Model]) -> bytes:
    """Return the words of section 2.6: the symbols in reverse order onto a state that is empty at first."""
    state, out = 0, bytearray()
    for column, model in reversed(list(zip(columns, models, strict=True))):
        if len(model.counts) == 1:
            continue
        left, bins = intervals(model.counts), len(model.counts) - model.escape
        for value in reversed(column):
            entry = value - model.low if 0 <= value - model.low < bins else bins
            low, width = left[entry], left[entry + 1] - left[entry]
            if state >= width << 40:
                out += (state & 0xFFFFFFFF).to_bytes(4, "little")
                state >>= 32
            state = ((state // width) << 24) + state % width + low
    while state:
        out += (state & 0xFFFFFFFF).to_bytes(4, "little")
        state >>= 32
    return bytes(out)


def constant(value: int, rows: int, channels: int = 1) -> bytes:
    """Return symbols that all are one value."""
    return table([[value] * rows] * channels, [Model(value, [1])], shared=True) if rows * channels else b""


def run_gates(runs: Sequence[int], first: int, levels: int = 1, said: Sequence[int] = ()) -> bytes:
    """Return gates of runs; the last one is not written. Levels of open entries are ``said``."""
    sent = [length - 1 for length in runs[:-1]]
    extra: list[tuple[str, int, int]] = []
    tokens: list[list[int]] = []
    for part in (sent[0::2], sent[1::2]):
        tokens.append([])
        for value in part:
            n = value.bit_length() - 1
            tokens[-1].append(value if value < 16 else 16 + 2 * (n - 4) + (value >> (n - 1) & 1))
            if value >= 16:
                extra.append(("bits", value & ((1 << (n - 1)) - 1), n - 1))
    top = bits(("gamma", levels - 1), ("gamma", len(runs)), ("bits", first, 1), *extra)
    return parts(top, column(tokens[0]), column(tokens[1]), column(said))


def column(values: Sequence[int]) -> bytes:
    """Return symbols [A, 1] of values that lie near each other, with a plain histogram."""
    if not values:
        return b""
    low = min(values)
    counts = [0] * (max(values) - low + 1)
    for value in values:
        counts[value - low] += 1
    return table([values], [Model(low, counts)])
