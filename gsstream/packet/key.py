"""Key packets: the whole state, quantised once so that encoder and player continue from the same bits."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from gsstream.core.changes import Layout
from gsstream.core.errors import PacketError, ShapeError
from gsstream.core.gaussians import ATTRIBUTES, Gaussians
from gsstream.core.shapes import BoolArray, FloatArray
from gsstream.packet.base import (
    MAX_GAUSSIANS,
    MAX_META,
    MAX_UNIT,
    MAX_UNITS,
    EncodedPacket,
    PacketKind,
    add_offset,
    build_packet,
    expect,
    most_gaussians,
)
from gsstream.packet.bits import compress, decompress, pack_blobs, unpack_blobs
from gsstream.packet.layers import ORDER, decode_layers, in_layers
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
    """Return the Gaussians a decoder of the key packet will have, float32. Doing it again changes no bit.

    Quaternions become unit quaternions whose largest component is positive (the rotation stays). Raises ShapeError for
    values that are not finite, far out of range, or quaternions of norm zero.
    """
    gaussians.validate()
    return decoded_rows(gaussians, row_codes(gaussians))


def encode_key(state: KeyState, *, frame: int = 0, first: BoolArray | None = None) -> EncodedPacket:
    """Encode a key packet; ``decode_key`` gives ``quantise_key(state.gaussians)``. Raises ShapeError on a bad state."""
    gaussians, layout = state.gaussians, state.layout
    gaussians.validate()
    _check_layout(gaussians, layout)
    about, stored = compress(meta_to_json(state.meta)), _encode_layout(layout)
    if first is None:
        sections = [("meta", about), ("layout", stored), *encode_rows(gaussians).items()]
    else:
        sections = in_layers(about, stored, gaussians, first)
    packet = build_packet(PacketKind.KEY, frame, sections)
    if len(gaussians) > most_gaussians(len(packet.data)):
        raise ShapeError(
            f"expected Gaussians that differ, got {len(gaussians)} of them in {len(packet.data)} bytes; "
            "readers refuse so many equal ones"
        )
    return packet


def decode_key(data: bytes, *, offset: int = 0) -> KeyState:
    """Decode a complete key packet. ``offset`` is its place in the file. Raises PacketError."""
    _, sections = expect(data, offset, PacketKind.KEY)
    wanted = {"meta", "layout", *ATTRIBUTES}
    if tuple(sections) != ORDER and set(sections) != wanted:
        raise PacketError(
            f"key packet: expected sections {sorted(wanted)} in any order, or {list(ORDER)} in this one, got "
            f"{list(sections)}",
            offset,
        )
    with add_offset(sections["meta"].offset):
        meta = meta_from_json(decompress(sections["meta"].data, MAX_META))
    with add_offset(sections["layout"].offset):
        layout = _decode_layout(sections["layout"].data, most_gaussians(len(data)))
    number = len(layout.unit_of)
    if "layers" in sections:
        gaussians = decode_layers(data, sections, number, offset)
    else:
        gaussians = decode_rows({name: sections[name] for name in ATTRIBUTES}, number)
    return KeyState(gaussians, layout, meta)


def _check_layout(gaussians: Gaussians[FloatArray], layout: Layout) -> None:
    number, unit_of = len(gaussians), layout.unit_of
    if number > MAX_GAUSSIANS:
        raise ShapeError(f"expected at most {MAX_GAUSSIANS} Gaussians, got {number}")
    nodes = int(np.sum(layout.node_counts))
    if len(unit_of) != number or nodes != number or np.any(np.asarray(layout.node_counts) < 0):
        raise ShapeError(f"layout: expected {number} Gaussians, got nodes holding {nodes} and {len(unit_of)} units")
    if len(layout.node_counts) > MAX_GAUSSIANS or len(layout.units) > MAX_UNITS:
        raise ShapeError(f"layout: at most {MAX_GAUSSIANS} nodes and {MAX_UNITS} units")
    if not _sound(np.asarray(layout.units, np.float32)):
        raise ShapeError(f"layout: units: expected numbers above 0 and below {MAX_UNIT:g}, got {layout.units}")
    if number and int(np.max(unit_of)) >= len(layout.units):
        raise ShapeError(f"layout: expected units 0 to {len(layout.units) - 1}, got {int(np.max(unit_of))}")


def _sound(units: FloatArray) -> bool:
    # R-3.5-3; not a number is neither above nor below.
    return bool(((units > 0) & (units < MAX_UNIT)).all())


def _encode_layout(layout: Layout) -> bytes:
    head = _LAYOUT.pack(len(layout.unit_of), len(layout.node_counts), len(layout.units))
    units = np.asarray(layout.units, "<f4").tobytes()
    counts = encode_symbols(np.asarray(layout.node_counts, np.int32)[:, None])
    return head + units + pack_blobs([counts, encode_symbols(layout.unit_of.astype(np.int32)[:, None])])


def _decode_layout(data: bytes, most: int) -> Layout:
    if len(data) < _LAYOUT.size:
        raise PacketError("layout cut short")
    number, nodes, number_of_units = _LAYOUT.unpack_from(data)
    if number > most or nodes > most or number_of_units > MAX_UNITS:
        raise PacketError(
            f"layout of {number} Gaussians, {nodes} nodes, {number_of_units} units is beyond the limits: at most "
            f"{most} Gaussians and nodes in a packet of this size, {MAX_UNITS} units"
        )
    rest = data[_LAYOUT.size :]
    if len(rest) < 4 * number_of_units:
        raise PacketError("units cut short")
    units = np.frombuffer(rest[: 4 * number_of_units], "<f4").astype(np.float32)
    counts_blob, units_blob = unpack_blobs(rest[4 * number_of_units :], 2)
    counts = decode_symbols(counts_blob, nodes, 1)[:, 0]
    if nodes and (int(counts.min()) < 0 or int(counts.sum(dtype=np.int64)) != number):
        raise PacketError(f"layout: nodes hold {int(counts.sum(dtype=np.int64))} Gaussians, {number} were announced")
    unit_of = decode_symbols(units_blob, number, 1)[:, 0]
    if number and not 0 <= int(unit_of.min()) <= int(unit_of.max()) < number_of_units:
        raise PacketError(f"layout: units {int(unit_of.min())} to {int(unit_of.max())}, {number_of_units} are given")
    if number and not nodes:
        raise PacketError(f"layout: {number} Gaussians in no node")
    if not _sound(units):
        raise PacketError(f"layout: units: expected numbers above 0 and below {MAX_UNIT:g}")
    return Layout(np.ascontiguousarray(counts), unit_of.astype(np.uint8), units)
