"""Key packets: the whole state, quantised once so that encoder and player continue from the same bits."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from gsstream.core.delta import Layout
from gsstream.core.errors import PacketError, ShapeError
from gsstream.core.gaussians import ATTRIBUTES, Gaussians
from gsstream.core.shapes import FloatArray
from gsstream.packet.base import (
    FREE_GAUSSIANS,
    MAX_GAUSSIANS,
    MAX_GAUSSIANS_PER_BYTE,
    MAX_LEVELS,
    MAX_META,
    EncodedPacket,
    PacketKind,
    build_packet,
    expect,
    located,
)  # fmt: skip
from gsstream.packet.bits import pack_blobs, unpack_blobs
from gsstream.packet.bulk import compress, decompress
from gsstream.packet.meta import StreamMeta, meta_from_json, meta_to_json
from gsstream.packet.rows import decode_rows, decoded_rows, encode_rows, row_codes
from gsstream.packet.symbols import decode_symbols, encode_symbols

_LAYOUT = struct.Struct("<IIB")


@dataclass(frozen=True, slots=True)
class KeyState:
    """Everything a player needs to start: scene, layout, meta."""

    gaussians: Gaussians[FloatArray]
    layout: Layout
    meta: StreamMeta


def quantise_key(gaussians: Gaussians[FloatArray]) -> Gaussians[FloatArray]:
    """The Gaussians a decoder of the key packet will have, float32. Idempotent bitwise.

    Quaternions become unit quaternions whose largest component is positive (the rotation stays). Raises ShapeError for
    values that are not finite, far out of range, or quaternions of norm zero.
    """
    gaussians.validate()
    return decoded_rows(gaussians, row_codes(gaussians))


def encode_key(state: KeyState, *, frame: int = 0) -> EncodedPacket:
    """Encode a key packet; ``decode_key`` gives ``quantise_key(state.gaussians)``. Raises ShapeError on a bad state."""
    gaussians, layout = state.gaussians, state.layout
    gaussians.validate()
    _check_layout(gaussians, layout)
    sections = [("meta", compress(meta_to_json(state.meta))), ("layout", _encode_layout(layout))]
    sections += encode_rows(gaussians).items()
    packet = build_packet(PacketKind.KEY, frame, sections)
    if len(gaussians) > most_gaussians(len(packet.data)):
        raise ShapeError(
            f"expected Gaussians that differ, got {len(gaussians)} of them in {len(packet.data)} bytes; "
            "readers refuse so many equal ones"
        )
    return packet


def most_gaussians(size: int) -> int:
    """How many Gaussians (and nodes) a key packet of ``size`` bytes may announce: bounds what a small lie costs."""
    return min(MAX_GAUSSIANS, FREE_GAUSSIANS + MAX_GAUSSIANS_PER_BYTE * size)


def decode_key(data: bytes, *, offset: int = 0) -> KeyState:
    """Decode a complete key packet. ``offset`` is its place in the file. Raises PacketError."""
    _, sections = expect(data, offset, PacketKind.KEY)
    wanted = {"meta", "layout", *ATTRIBUTES}
    if set(sections) != wanted:
        raise PacketError(f"key packet: expected sections {sorted(wanted)}, got {sorted(sections)}", offset)
    with located(sections["meta"].offset):
        meta = meta_from_json(decompress(sections["meta"].data, MAX_META))
    with located(sections["layout"].offset):
        layout = _decode_layout(sections["layout"].data, most_gaussians(len(data)))
    number = len(layout.octree_levels)
    gaussians = decode_rows({name: sections[name] for name in ATTRIBUTES}, number)
    return KeyState(gaussians, layout, meta)


def _check_layout(gaussians: Gaussians[FloatArray], layout: Layout) -> None:
    number, levels = len(gaussians), layout.octree_levels
    if number > MAX_GAUSSIANS:
        raise ShapeError(f"expected at most {MAX_GAUSSIANS} Gaussians, got {number}")
    if len(levels) != number or int(np.sum(layout.node_counts)) != number or np.any(np.asarray(layout.node_counts) < 0):
        nodes = int(np.sum(layout.node_counts))
        raise ShapeError(f"layout: expected {number} Gaussians, got nodes holding {nodes} and {len(levels)} levels")
    if len(layout.node_counts) > MAX_GAUSSIANS or len(layout.cell_sizes) > MAX_LEVELS:
        raise ShapeError(f"layout: at most {MAX_GAUSSIANS} nodes and {MAX_LEVELS} levels")
    if number and int(np.max(levels)) >= len(layout.cell_sizes):
        raise ShapeError(f"layout: level {int(np.max(levels))} has no cell size (there are {len(layout.cell_sizes)})")


def _encode_layout(layout: Layout) -> bytes:
    head = _LAYOUT.pack(len(layout.octree_levels), len(layout.node_counts), len(layout.cell_sizes))
    cells = np.asarray(layout.cell_sizes, "<f4").tobytes()
    counts = encode_symbols(np.asarray(layout.node_counts, np.int32)[:, None])
    return head + cells + pack_blobs([counts, encode_symbols(layout.octree_levels.astype(np.int32)[:, None])])


def _decode_layout(data: bytes, most: int) -> Layout:
    if len(data) < _LAYOUT.size:
        raise PacketError("layout cut short")
    number, nodes, levels = _LAYOUT.unpack_from(data)
    if number > most or nodes > most or levels > MAX_LEVELS:
        raise PacketError(
            f"layout of {number} Gaussians, {nodes} nodes, {levels} levels is beyond the limits: at most {most} "
            f"Gaussians and nodes in a packet of this size, {MAX_LEVELS} levels"
        )
    rest = data[_LAYOUT.size :]
    if len(rest) < 4 * levels:
        raise PacketError("cell sizes cut short")
    cells = np.frombuffer(rest[: 4 * levels], "<f4").astype(np.float32)
    counts_blob, levels_blob = unpack_blobs(rest[4 * levels :], 2)
    counts = decode_symbols(counts_blob, nodes, 1)[:, 0]
    if nodes and (int(counts.min()) < 0 or int(counts.sum(dtype=np.int64)) != number):
        raise PacketError(f"layout: nodes hold {int(counts.sum(dtype=np.int64))} Gaussians, {number} were announced")
    octree = decode_symbols(levels_blob, number, 1)[:, 0]
    if number and not 0 <= int(octree.min()) <= int(octree.max()) < levels:
        raise PacketError(f"layout: levels {int(octree.min())} to {int(octree.max())} need cell sizes, {levels} given")
    if number and not nodes:
        raise PacketError(f"layout: {number} Gaussians in no node")
    if not (np.isfinite(cells).all() and (cells > 0).all()):
        raise PacketError("layout: cell sizes must be finite and positive")
    return Layout(np.ascontiguousarray(counts), octree.astype(np.uint8), cells)
