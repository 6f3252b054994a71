"""The entropy-coded tables of a packet and their least possible size: for measuring the coder, not for decoding."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from gsstream.core.changes import Layout
from gsstream.core.gaussians import ATTRIBUTES
from gsstream.core.shapes import IntArray
from gsstream.packet.base import MAX_GAUSSIANS, PacketKind, Section
from gsstream.packet.bits import unpack_blobs
from gsstream.packet.changes.residual import decode_pattern
from gsstream.packet.changes.rows import HEAD_PARTS, decode_added
from gsstream.packet.gates import decode_gates, run_tokens
from gsstream.packet.layers import read_head
from gsstream.packet.symbols import decode_symbols

_KEY_HEAD, _DELTA_HEAD, _MEANS_HEAD, _LAYOUT_HEAD = 2, 6, 3, 9


class Table(NamedTuple):
    """A coded section or part: its bytes, and the empirical entropy of its symbols."""

    name: str
    size: int
    entropy_bits: float


def coded_tables(sections: Mapping[str, Section], kind: PacketKind, layout: Layout) -> list[Table]:
    """Return the tables of a sound packet; ``layout`` is that before it (a key packet's own)."""
    if kind == PacketKind.KEY:
        return list(_key_tables({name: section.data for name, section in sections.items()}, layout))
    if kind == PacketKind.DELTA:
        return list(_delta_tables({name: section.data for name, section in sections.items()}, layout))
    return []


def table_entropy(data: bytes, symbols: IntArray) -> float:
    """Return the zero-order entropy of the symbols in bits, by channel or of all together, as ``data`` was modelled."""
    if symbols.size == 0:
        return 0.0
    shared = unpack_blobs(data, 2)[0][0] >> 7
    groups = [symbols] if shared else list(symbols.T)
    return sum(_entropy(group) for group in groups)


def _entropy(values: IntArray) -> float:
    _, counts = np.unique(values, return_counts=True)
    return float((counts * np.log2(counts.sum() / counts)).sum())


def _key_tables(data: Mapping[str, bytes], layout: Layout) -> Iterator[Table]:
    number, nodes = len(layout.unit_of), len(layout.node_counts)
    parts = unpack_blobs(data["layout"][_LAYOUT_HEAD + 4 * len(layout.units) :], 2)
    for part, rows in zip(parts, (nodes, number), strict=True):
        yield _table("layout", part, rows, 1)
    if "layers" not in data:
        yield from _row_tables(data, number)
        return
    in_first, _, _ = read_head(data["layers"])
    yield from _row_tables(data, in_first)
    marks, *parts = unpack_blobs(data["rest"], 1 + len(ATTRIBUTES))
    yield _table("rest", marks, number, 1)
    later = dict(zip(ATTRIBUTES, parts, strict=True))
    yield from (table._replace(name="rest") for table in _row_tables(later, number - in_first))


def _row_tables(data: Mapping[str, bytes], number: int) -> Iterator[Table]:
    """Attributes of whole Gaussians."""
    if number:
        cells, local = unpack_blobs(data["means"][_MEANS_HEAD:], 2)
        yield _table("means", cells, number, 3)
        yield Table("means", len(local), 8.0 * len(local))
    for name in ATTRIBUTES:
        if name != "means":
            width = data[name][1] + (name == "quats")
            yield _table(name, data[name][_KEY_HEAD:], number, width)


def _delta_tables(data: Mapping[str, bytes], layout: Layout) -> Iterator[Table]:
    for name in ("motion", "field"):
        if name in data:
            # Its tables depend on the whole scene, which is not at hand; its entropy is taken to be its size.
            yield Table(name, len(data[name]), 8.0 * len(data[name]))
    if "gates" in data:
        yield from _residual_tables(data, layout)
    if "removed" in data:
        gone, _ = decode_gates(data["removed"], len(layout.unit_of))
        yield _runs_table("removed", data["removed"], gone)
    if "added" in data:
        yield from _added_tables(data["added"], layout)


def _residual_tables(data: Mapping[str, bytes], layout: Layout) -> Iterator[Table]:
    gates, num_levels = decode_gates(data["gates"], len(layout.node_counts))
    rows = int(np.asarray(layout.node_counts)[gates != 0].sum())
    tokens, plain_bits = run_tokens(gates)
    parts = unpack_blobs(data["gates"], 4)[1:]
    levels = gates[gates != 0].astype(np.int32)[:, None] if num_levels > 1 else np.zeros((0, 1), np.int32)
    best = [table_entropy(part, table) for part, table in zip(parts, [*tokens, levels], strict=True)]
    yield Table("gates", len(data["gates"]), sum(best) + plain_bits)
    names = [name for name in ATTRIBUTES if name in data]
    pattern = None
    if "pattern" in data:
        pattern = decode_pattern(data["pattern"], rows, len(names))
        yield _table("pattern", data["pattern"], rows, 1)
    for bit, name in enumerate(names):
        number = rows if pattern is None else int(np.count_nonzero(pattern >> bit & 1))
        yield _table(name, data[name][_DELTA_HEAD:], number, data[name][1])


def _runs_table(name: str, data: bytes, marks: IntArray) -> Table:
    """Marks coded as runs without levels."""
    tokens, plain_bits = run_tokens(marks)
    best = [table_entropy(part, table) for part, table in zip(unpack_blobs(data, 4)[1:3], tokens, strict=True)]
    return Table(name, len(data), sum(best) + plain_bits)


def _added_tables(data: bytes, layout: Layout) -> Iterator[Table]:
    nodes = len(layout.node_counts)
    added = decode_added(Section(data, 0), nodes, len(layout.units), MAX_GAUSSIANS)
    blobs = unpack_blobs(data, HEAD_PARTS + len(ATTRIBUTES))
    used, _ = decode_gates(blobs[2], nodes + len(added.parents))
    yield _table("added", blobs[1], len(added.parents), 1)
    yield _runs_table("added", blobs[2], used)
    yield _table("added", blobs[3], int(np.count_nonzero(used)), 1)
    yield _table("added", blobs[4], len(added), 1)
    rows = dict(zip(ATTRIBUTES, blobs[HEAD_PARTS:], strict=True))
    yield from (table._replace(name="added") for table in _row_tables(rows, len(added)))


def _table(name: str, data: bytes, rows: int, channels: int) -> Table:
    bits = table_entropy(data, decode_symbols(data, rows, channels))
    assert math.isfinite(bits)
    return Table(name, len(data), bits)
