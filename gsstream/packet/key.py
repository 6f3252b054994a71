"""Key packets: the whole state, quantised once so that encoder and player continue from the same bits."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from gsstream.core.delta import Layout
from gsstream.core.errors import PacketError, ShapeError
from gsstream.core.gaussians import ATTRIBUTES, Gaussians
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.packet.base import (
    FREE_GAUSSIANS,
    MAX_GAUSSIANS,
    MAX_GAUSSIANS_PER_BYTE,
    MAX_LEVELS,
    MAX_META,
    WIDTHS,
    EncodedPacket,
    PacketKind,
    Section,
    build_packet,
    expect,
    located,
)  # fmt: skip
from gsstream.packet.bits import pack_blobs, unpack_blobs
from gsstream.packet.bulk import compress, decompress
from gsstream.packet.grids import KEY_BITS, MAX_BITS, MAX_CODE, fold_quats, from_codes, to_codes, unfold_quats
from gsstream.packet.meta import StreamMeta, meta_from_json, meta_to_json
from gsstream.packet.positions import decode_positions, encode_positions, quantise_positions
from gsstream.packet.symbols import decode_symbols, encode_symbols

_LAYOUT = struct.Struct("<IIB")
_FIXED = struct.Struct("<bB")


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
    return _decoded(gaussians, _codes(gaussians))


def encode_key(state: KeyState, *, frame: int = 0) -> EncodedPacket:
    """Encode a key packet; ``decode_key`` gives ``quantise_key(state.gaussians)``. Raises ShapeError on a bad state."""
    gaussians, layout = state.gaussians, state.layout
    gaussians.validate()
    _check_layout(gaussians, layout)
    codes = _codes(gaussians)
    means = _decoded(gaussians, codes).means
    sections = [("meta", compress(meta_to_json(state.meta))), ("layout", _encode_layout(layout))]
    sections.append(("means", encode_positions(means, codes["scales"], KEY_BITS["scales"])))
    for name, table in codes.items():
        head = _FIXED.pack(KEY_BITS[name], table.shape[1])
        sections.append((name, head + encode_symbols(fold_quats(table, KEY_BITS[name]) if name == "quats" else table)))
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
    arrays: dict[str, FloatArray] = {}
    for name in KEY_BITS:
        with located(sections[name].offset):
            codes, bits = _decode_codes(name, sections[name], number)
            arrays[name] = _shaped(name, from_codes(name, codes, bits))
        if name == "scales":
            with located(sections["means"].offset):
                arrays["means"] = decode_positions(sections["means"].data, codes, bits)
    return KeyState(Gaussians(**arrays), layout, meta)


def _codes(gaussians: Gaussians[FloatArray]) -> dict[str, IntArray]:
    """Attribute -> [N, width] int32 fixed-point codes."""
    return {name: to_codes(name, getattr(gaussians, name), bits) for name, bits in KEY_BITS.items()}


def _decoded(gaussians: Gaussians[FloatArray], codes: dict[str, IntArray]) -> Gaussians[FloatArray]:
    out = {name: _shaped(name, from_codes(name, table, KEY_BITS[name])) for name, table in codes.items()}
    out["means"] = quantise_positions(gaussians.means, codes["scales"], KEY_BITS["scales"])
    return Gaussians(**out)


def _shaped(name: str, flat: FloatArray) -> FloatArray:
    """[N, width] in the shape of the attribute."""
    number, width = flat.shape
    shapes = {"opacities": (number,), "sh0": (number, 1, 3), "shN": (number, width // 3, 3)}
    return flat.reshape(shapes.get(name, (number, width)))


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


def _decode_codes(name: str, section: Section, number: int) -> tuple[IntArray, int]:
    """[N, width] int32 codes of an attribute and their fractional bits."""
    if len(section.data) < _FIXED.size:
        raise PacketError(f"{name} cut short")
    bits, width = _FIXED.unpack_from(section.data)
    if width not in WIDTHS[name] or not 1 <= bits <= MAX_BITS:
        raise PacketError(f"{name}: {width} channels of {bits} fractional bits cannot be")
    payload = section.data[_FIXED.size :]
    if name == "quats":
        return unfold_quats(decode_symbols(payload, number, width + 1), bits), bits
    codes = decode_symbols(payload, number, width)
    if codes.size and max(int(codes.max()), -int(codes.min())) >= MAX_CODE:
        raise PacketError(f"{name}: code out of range")
    return codes, bits
