"""Rows of a delta packet: those that leave as runs (deaths), those that join coded as in a key packet (births)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gsstream.core.changes import AddedGaussians, Layout, Rows
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


def encode_rows_change(rows: Rows, layout: Layout) -> list[tuple[str, bytes]]:
    """Return the sections of a change of rows. Raises ShapeError when it does not fit the layout it applies to."""
    check_removed(rows.deaths, len(layout.unit_of))
    sections = []
    if len(rows.deaths):
        sections.append(("deaths", encode_removed(rows.deaths, len(layout.unit_of))))
    if rows.births is not None:
        _check_added(rows.births, layout, len(rows.deaths))
        sections.append(("births", encode_added(rows.births, len(layout.node_counts))))
    return sections


def decode_rows_change(sections: Mapping[str, Section], layout: Layout) -> Rows | None:
    """Return the rows that leave and join, if any do. Raises PacketError."""
    number = len(layout.unit_of)
    deaths: IntArray = np.zeros(0, np.int64)
    births: AddedGaussians | None = None
    if "deaths" in sections:
        with add_offset(sections["deaths"].offset):
            deaths = decode_removed(sections["deaths"].data, number)
    if "births" in sections:
        most = MAX_GAUSSIANS - (number - len(deaths))
        with add_offset(sections["births"].offset):
            births = decode_added(sections["births"], len(layout.node_counts), len(layout.units), most)
    return Rows(births, deaths) if births is not None or len(deaths) else None


def _check_added(births: AddedGaussians, layout: Layout, leaving: int) -> None:
    births.gaussians.validate()
    check_added(births, len(layout.node_counts), len(layout.units), [])
    after = len(layout.unit_of) - leaving + len(births)
    nodes = len(layout.node_counts) + len(births.parents)
    if len(births) == 0 or after > MAX_GAUSSIANS or nodes > MAX_GAUSSIANS:
        raise ShapeError(
            f"births: expected at least 1, and at most {MAX_GAUSSIANS} Gaussians and nodes afterwards, got "
            f"{len(births)}, {after} and {nodes}; without any leave births None"
        )


def encode_removed(deaths: IntArray, number: int) -> bytes:
    """Encode the rows [D] that leave a scene of N, as runs of those that stay and those that go."""
    gone = np.zeros(number, np.uint8)
    gone[deaths] = 1
    return encode_gates(gone, 1)


def decode_removed(data: bytes, number: int) -> IntArray:
    """Decode what :func:`encode_removed` wrote. Raises PacketError (without offset)."""
    gone, levels = decode_gates(data, number)
    if levels != 1 or not gone.any():
        raise PacketError("deaths: no row leaves, or rows leave by levels")
    return np.flatnonzero(gone)


def encode_added(births: AddedGaussians, num_nodes: int) -> bytes:
    """Encode births into a scene of M nodes. The Gaussians are quantised as in a key packet."""
    new = len(births.parents)
    head = BitWriter()
    head.gamma(len(births) - 1)
    head.gamma(new)
    up = num_nodes + np.arange(new) - births.parents
    counts = np.bincount(births.nodes, minlength=num_nodes + new)
    used = counts > 0
    parts = [
        head.to_bytes(),
        encode_symbols(up.astype(np.int32)[:, None]),
        encode_gates(used.astype(np.uint8), 1),
        encode_symbols(counts[used].astype(np.int32)[:, None]),
        encode_symbols(births.unit_of.astype(np.int32)[:, None]),
    ]
    rows = encode_rows(births.gaussians)
    data = pack_blobs([*parts, *(rows[name] for name in ATTRIBUTES)])
    if max(len(births), new) > max_added_in(len(data)):
        raise ShapeError(
            f"births: expected Gaussians that differ, got {len(births)} of them and {new} nodes in {len(data)} bytes; "
            "readers refuse so many equal ones"
        )
    return data


def decode_added(section: Section, num_nodes: int, num_units: int, most: int) -> AddedGaussians:
    """Decode births into a scene of M nodes and H units that may grow by ``most`` Gaussians.

    Raises PacketError (without offset where it is that of the section).
    """
    blobs = unpack_blobs(section.data, HEAD_PARTS + len(ATTRIBUTES))
    head = BitReader(blobs[0])
    number, new = head.gamma() + 1, head.gamma()
    head.finish()
    allowed = max_added_in(len(section.data))
    if number > min(allowed, most) or new > min(allowed, MAX_GAUSSIANS - num_nodes):
        raise PacketError(f"births of {number} Gaussians and {new} nodes are beyond the limits")
    up = decode_symbols(blobs[1], new, 1)[:, 0].astype(np.int64)
    own = num_nodes + np.arange(new)
    if new and (int(up.min()) < 0 or bool(np.any(up > own))):
        raise PacketError("births: a parent that is no node before its own")
    used, levels_of_use = decode_gates(blobs[2], num_nodes + new)
    counts = decode_symbols(blobs[3], int(np.count_nonzero(used)), 1)[:, 0]
    if levels_of_use != 1 or (counts.size and int(counts.min()) < 1) or int(counts.sum(dtype=np.int64)) != number:
        raise PacketError(f"births: nodes receive {int(counts.sum(dtype=np.int64))} Gaussians, {number} were announced")
    units = decode_symbols(blobs[4], number, 1)[:, 0]
    if not 0 <= int(units.min()) <= int(units.max()) < num_units:
        raise PacketError(f"births: units {int(units.min())} to {int(units.max())}, the scene has {num_units}")
    at = {name: Section(data, section.offset) for name, data in zip(ATTRIBUTES, blobs[HEAD_PARTS:], strict=True)}
    nodes = np.repeat(np.flatnonzero(used), counts)
    return AddedGaussians(decode_rows(at, number), nodes, units.astype(np.uint8), own - up)
