"""Rows of a delta packet: those that are removed, as runs; those that are added, coded as in a key packet."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gsstream.core.changes import AddedGaussians, Layout, RowEdit
from gsstream.core.changes.rows import check_added, check_removed
from gsstream.core.errors import PacketError, ShapeError
from gsstream.core.gaussians import ATTRIBUTES
from gsstream.core.shapes import IntArray
from gsstream.packet.base import MAX_GAUSSIANS, MAX_GAUSSIANS_PER_BYTE, Section, add_offset
from gsstream.packet.bits import BitReader, BitWriter, pack_blobs, unpack_blobs
from gsstream.packet.gates import decode_gates, encode_gates
from gsstream.packet.rows import decode_rows, encode_rows
from gsstream.packet.symbols import decode_symbols, encode_symbols

#: Parts of the section before the attributes: head, parents, nodes, counts, units.
HEAD_PARTS = 5


def max_added_in(size: int) -> int:
    """Return how many Gaussians, and how many nodes, a section of ``size`` bytes may announce."""
    return min(MAX_GAUSSIANS, MAX_GAUSSIANS_PER_BYTE * size)


def encode_rows_change(rows: RowEdit, layout: Layout) -> list[tuple[str, bytes]]:
    """Return the sections of a change of rows. Raises ShapeError when it does not fit the layout it applies to."""
    check_removed(rows.removed, len(layout.unit_of))
    sections = []
    if len(rows.removed):
        sections.append(("removed", encode_removed(rows.removed, len(layout.unit_of))))
    if rows.added is not None:
        _check_added(rows.added, layout, len(rows.removed))
        sections.append(("added", encode_added(rows.added, len(layout.node_counts))))
    return sections


def decode_rows_change(sections: Mapping[str, Section], layout: Layout) -> RowEdit | None:
    """Return the rows that leave and join, if any do. Raises PacketError."""
    number = len(layout.unit_of)
    removed: IntArray = np.zeros(0, np.int64)
    added: AddedGaussians | None = None
    if "removed" in sections:
        with add_offset(sections["removed"].offset):
            removed = decode_removed(sections["removed"].data, number)
    if "added" in sections:
        most = MAX_GAUSSIANS - (number - len(removed))
        with add_offset(sections["added"].offset):
            added = decode_added(sections["added"], len(layout.node_counts), len(layout.units), most)
    return RowEdit(added, removed) if added is not None or len(removed) else None


def _check_added(added: AddedGaussians, layout: Layout, leaving: int) -> None:
    added.gaussians.validate()
    check_added(added, len(layout.node_counts), len(layout.units), [])
    after = len(layout.unit_of) - leaving + len(added)
    nodes = len(layout.node_counts) + len(added.parents)
    if len(added) == 0 or after > MAX_GAUSSIANS or nodes > MAX_GAUSSIANS:
        raise ShapeError(
            f"added: expected at least 1, and at most {MAX_GAUSSIANS} Gaussians and nodes afterwards, got "
            f"{len(added)}, {after} and {nodes}; without any leave added None"
        )


def encode_removed(removed: IntArray, number: int) -> bytes:
    """Encode the rows [D] that leave a scene of N, as runs of those that stay and those that go."""
    gone = np.zeros(number, np.uint8)
    gone[removed] = 1
    return encode_gates(gone, 1)


def decode_removed(data: bytes, number: int) -> IntArray:
    """Decode the rows that :func:`encode_removed` wrote. Raises PacketError (without offset)."""
    gone, levels = decode_gates(data, number)
    if levels != 1 or not gone.any():
        raise PacketError("removed: no row leaves, or rows leave by levels")
    return np.flatnonzero(gone)


def encode_added(added: AddedGaussians, num_nodes: int) -> bytes:
    """Encode added Gaussians into a scene of M nodes. The Gaussians are quantised as in a key packet."""
    new = len(added.parents)
    head = BitWriter()
    head.gamma(len(added) - 1)
    head.gamma(new)
    up = num_nodes + np.arange(new) - added.parents
    counts = np.bincount(added.nodes, minlength=num_nodes + new)
    used = counts > 0
    parts = [
        head.to_bytes(),
        encode_symbols(up.astype(np.int32)[:, None]),
        encode_gates(used.astype(np.uint8), 1),
        encode_symbols(counts[used].astype(np.int32)[:, None]),
        encode_symbols(added.unit_of.astype(np.int32)[:, None]),
    ]
    rows = encode_rows(added.gaussians)
    data = pack_blobs([*parts, *(rows[name] for name in ATTRIBUTES)])
    if max(len(added), new) > max_added_in(len(data)):
        raise ShapeError(
            f"added: expected Gaussians that differ, got {len(added)} of them and {new} nodes in {len(data)} bytes; "
            "readers refuse so many equal ones"
        )
    return data


def decode_added(section: Section, num_nodes: int, num_units: int, most: int) -> AddedGaussians:
    """Decode added Gaussians into a scene of M nodes and H units that may grow by ``most`` Gaussians.

    Raises PacketError (without offset where it is that of the section).
    """
    blobs = unpack_blobs(section.data, HEAD_PARTS + len(ATTRIBUTES))
    head = BitReader(blobs[0])
    number, new = head.gamma() + 1, head.gamma()
    head.finish()
    allowed = max_added_in(len(section.data))
    if number > min(allowed, most) or new > min(allowed, MAX_GAUSSIANS - num_nodes):
        raise PacketError(f"added: {number} Gaussians and {new} nodes are beyond the limits")
    up = decode_symbols(blobs[1], new, 1)[:, 0].astype(np.int64)
    own = num_nodes + np.arange(new)
    if new and (int(up.min()) < 0 or bool(np.any(up > own))):
        raise PacketError("added: a parent that is no node before its own")
    used, levels_of_use = decode_gates(blobs[2], num_nodes + new)
    counts = decode_symbols(blobs[3], int(np.count_nonzero(used)), 1)[:, 0]
    if levels_of_use != 1 or (counts.size and int(counts.min()) < 1) or int(counts.sum(dtype=np.int64)) != number:
        raise PacketError(f"added: nodes receive {int(counts.sum(dtype=np.int64))} Gaussians, {number} were announced")
    units = decode_symbols(blobs[4], number, 1)[:, 0]
    if not 0 <= int(units.min()) <= int(units.max()) < num_units:
        raise PacketError(f"added: units {int(units.min())} to {int(units.max())}, the scene has {num_units}")
    at = {name: Section(data, section.offset) for name, data in zip(ATTRIBUTES, blobs[HEAD_PARTS:], strict=True)}
    nodes = np.repeat(np.flatnonzero(used), counts)
    return AddedGaussians(decode_rows(at, number), nodes, units.astype(np.uint8), own - up)
