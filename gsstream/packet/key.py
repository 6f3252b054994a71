"""Key packets: the whole state, quantised once so that encoder and player continue from the same bits."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gsstream.core.delta import Layout
from gsstream.core.errors import PacketError, ShapeError
from gsstream.core.gaussians import ATTRIBUTES, Gaussians
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.packet.base import (
    MAX_GAUSSIANS,
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
from gsstream.packet.bulk import compress, decompress, pack_array, unpack_array
from gsstream.packet.meta import StreamMeta, meta_from_json, meta_to_json
from gsstream.packet.symbols import decode_symbols, encode_symbols

#: Fractional bits of each quantised attribute (raw units). Powers of two: the grid is exact in float32, so that
#: quantising twice equals quantising once. Means stay float32.
KEY_BITS: Mapping[str, int] = {"quats": 10, "scales": 7, "opacities": 6, "sh0": 8, "shN": 7}
_MAX_CODE = 1 << 22
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

    Quaternions whose norm strays more than a tenth from one are scaled to unit norm (the rotation stays). Raises
    ShapeError for values that are not finite, far out of range, or quaternions of norm zero.
    """
    gaussians.validate()
    out = {"means": np.asarray(gaussians.means, np.float32) + np.float32(0)}  # -0 becomes +0
    for name, codes in _codes(gaussians).items():
        out[name] = _grid(codes, KEY_BITS[name]).reshape(getattr(gaussians, name).shape)
    return Gaussians(**out)


def encode_key(state: KeyState, *, frame: int = 0) -> EncodedPacket:
    """Encode a key packet; ``decode_key`` gives ``quantise_key(state.gaussians)``. Raises ShapeError on a bad state."""
    gaussians, layout = state.gaussians, state.layout
    gaussians.validate()
    _check_layout(gaussians, layout)
    sections = [("meta", compress(meta_to_json(state.meta))), ("layout", _encode_layout(layout))]
    sections.append(("means", pack_array(np.asarray(gaussians.means, np.float32) + np.float32(0), "<f4")))
    for name, codes in _codes(gaussians).items():
        head = _FIXED.pack(KEY_BITS[name], codes.shape[1])
        sections.append((name, head + encode_symbols(codes)))
    return build_packet(PacketKind.KEY, frame, sections)


def decode_key(data: bytes, *, offset: int = 0) -> KeyState:
    """Decode a complete key packet. ``offset`` is its place in the file. Raises PacketError."""
    _, sections = expect(data, offset, PacketKind.KEY)
    wanted = {"meta", "layout", *ATTRIBUTES}
    if set(sections) != wanted:
        raise PacketError(f"key packet: expected sections {sorted(wanted)}, got {sorted(sections)}", offset)
    with located(sections["meta"].offset):
        meta = meta_from_json(decompress(sections["meta"].data, MAX_META))
    with located(sections["layout"].offset):
        layout = _decode_layout(sections["layout"].data)
    number = len(layout.octree_levels)
    arrays: dict[str, FloatArray] = {}
    for name in ATTRIBUTES:
        with located(sections[name].offset):
            arrays[name] = _decode_attribute(name, sections[name], number)
    return KeyState(Gaussians(**arrays), layout, meta)


def _codes(gaussians: Gaussians[FloatArray]) -> dict[str, IntArray]:
    """Attribute -> [N, width] int32 fixed-point codes."""
    out: dict[str, IntArray] = {}
    for name, bits in KEY_BITS.items():
        values = np.asarray(getattr(gaussians, name), np.float64)
        values = values.reshape(len(gaussians), math.prod(values.shape[1:]))
        scaled = np.rint(values * 2.0**bits)
        if name == "quats":
            scaled = _unit(values, scaled, bits)
        if scaled.size and float(np.abs(scaled).max()) >= _MAX_CODE:
            raise ShapeError(
                f"{name}: expected values within +-{_MAX_CODE / 2**bits:g}, got {np.abs(values).max():g}; "
                "the optimisation has diverged"
            )
        out[name] = scaled.astype(np.int32)
    return out


def _unit(values: FloatArray, scaled: FloatArray, bits: int) -> FloatArray:
    # Decided on the rounded codes: what comes out is inside the band, so a second pass leaves it alone.
    rounded_norm = np.linalg.norm(scaled, axis=1) / 2.0**bits
    stray = np.abs(rounded_norm - 1) > 0.1
    norm = np.linalg.norm(values[stray], axis=1, keepdims=True)
    if norm.size and float(norm.min()) < 1e-30:
        row = int(np.flatnonzero(stray)[int(norm.argmin())])
        raise ShapeError(f"quats: row {row} has norm zero, which is no rotation")
    scaled[stray] = np.rint(values[stray] / norm * 2.0**bits)
    return scaled


def _grid(codes: IntArray, bits: int) -> FloatArray:
    return codes.astype(np.float32) * np.float32(2.0**-bits)


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
    return head + cells + pack_blobs([pack_array(layout.node_counts, "<u4"), pack_array(layout.octree_levels, "u1")])


def _decode_layout(data: bytes) -> Layout:
    if len(data) < _LAYOUT.size:
        raise PacketError("layout cut short")
    number, nodes, levels = _LAYOUT.unpack_from(data)
    if number > MAX_GAUSSIANS or nodes > MAX_GAUSSIANS or levels > MAX_LEVELS:
        raise PacketError(f"layout of {number} Gaussians, {nodes} nodes, {levels} levels is beyond the limits")
    rest = data[_LAYOUT.size :]
    if len(rest) < 4 * levels:
        raise PacketError("cell sizes cut short")
    cells = np.frombuffer(rest[: 4 * levels], "<f4").astype(np.float32)
    counts_blob, levels_blob = unpack_blobs(rest[4 * levels :], 2)
    counts = unpack_array(counts_blob, "<u4", nodes)
    if int(counts.sum(dtype=np.uint64)) != number:
        raise PacketError(f"layout: nodes hold {int(counts.sum(dtype=np.uint64))} Gaussians, {number} were announced")
    octree = unpack_array(levels_blob, "u1", number)
    if number and int(octree.max()) >= levels:
        raise PacketError(f"layout: level {int(octree.max())} has no cell size (there are {levels})")
    if not (np.isfinite(cells).all() and (cells > 0).all()):
        raise PacketError("layout: cell sizes must be finite and positive")
    return Layout(counts.astype(np.int32), octree.astype(np.uint8), cells)


def _decode_attribute(name: str, section: Section, number: int) -> FloatArray:
    if name == "means":
        means = np.asarray(unpack_array(section.data, "<f4", 3 * number), np.float32).reshape(number, 3)
        if not np.isfinite(means).all():
            raise PacketError("means: a value is not finite")
        return means
    if len(section.data) < _FIXED.size:
        raise PacketError(f"{name} cut short")
    bits, width = _FIXED.unpack_from(section.data)
    if width not in WIDTHS[name] or not 0 <= bits <= 20:
        raise PacketError(f"{name}: {width} channels of {bits} fractional bits cannot be")
    codes = decode_symbols(section.data[_FIXED.size :], number, width)
    if codes.size and max(int(codes.max()), -int(codes.min())) >= _MAX_CODE:
        raise PacketError(f"{name}: code out of range")
    shapes = {"opacities": (number,), "sh0": (number, 1, 3), "shN": (number, width // 3, 3)}
    return _grid(codes, bits).reshape(shapes.get(name, (number, width)))

