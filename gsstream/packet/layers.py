"""Key packets in two layers: first the Gaussians that a picture would miss most, whole, then the rest of them.

Section ``layers`` stands first. It says how many Gaussians the attribute sections hold, how many bytes the sections
behind it take that a picture needs, and what their checksum is: a player that has so many bytes can draw a picture that
it knows to be sound, while the rest is on its way. The rows of the scene are those it would have without layers.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from gsstream.core.errors import PacketError, ShapeError
from gsstream.core.gaussians import ATTRIBUTES, Gaussians
from gsstream.core.shapes import BoolArray, FloatArray
from gsstream.packet.base import (
    MAX_META,
    PACKET_HEADER,
    SECTION_HEADER,
    SECTION_IDS,
    PacketKind,
    Section,
    add_offset,
    most_gaussians,
    parse_header,
    split_sections,
)
from gsstream.packet.bits import decompress, pack_blobs, unpack_blobs
from gsstream.packet.grids import KEY_BITS
from gsstream.packet.meta import StreamMeta, meta_from_json
from gsstream.packet.positions import floor_exponent
from gsstream.packet.rows import decode_rows, decoded_rows, encode_codes, row_codes
from gsstream.packet.symbols import decode_symbols, encode_symbols

_LAYERS = struct.Struct("<III")
#: Offset of the bytes that section ``layers``, the first of its packet, describes.
_START = PACKET_HEADER.size + SECTION_HEADER.size + _LAYERS.size

#: Sections that the checksum of the first layer covers, and all sections of a packet with layers, in their order.
_VISIBLE = ("meta", *ATTRIBUTES)
ORDER = ("layers", *_VISIBLE, "layout", "rest")


class FirstLayer(NamedTuple):
    """The part of a key packet that can be drawn before the rest has arrived: rows in the order of the scene."""

    gaussians: Gaussians[FloatArray]
    meta: StreamMeta
    frame: int


def in_layers(
    meta: bytes, layout: bytes, gaussians: Gaussians[FloatArray], first: BoolArray
) -> list[tuple[str, bytes]]:
    """Return all sections of a key packet in two layers, in their order.

    Raises ShapeError when ``first`` does not fit.
    """
    if first.shape != (len(gaussians),) or first.dtype != np.bool_:
        raise ShapeError(f"first: expected [{len(gaussians)}] bool, got {list(first.shape)} {first.dtype}")
    codes = row_codes(gaussians)
    means = decoded_rows(gaussians, codes).means
    # Both layers lie on the grids of the whole scene, so that a decoded scene does not depend on the layers.
    floor = floor_exponent(codes["scales"], KEY_BITS["scales"]) if len(means) else None
    now, later = (
        encode_codes(means[rows], {name: table[rows] for name, table in codes.items()}, floor)
        for rows in (first, ~first)
    )
    payloads = {"meta": meta, "layout": layout, **now}
    body = b"".join(SECTION_HEADER.pack(SECTION_IDS[name], len(payloads[name])) + payloads[name] for name in _VISIBLE)
    payloads["layers"] = _LAYERS.pack(int(first.sum()), len(body), zlib.crc32(body))
    mask = encode_symbols(first[:, None].astype(np.int32))
    payloads["rest"] = pack_blobs([mask, *(later[name] for name in ATTRIBUTES)])
    return [(name, payloads[name]) for name in ORDER]


def decode_layers(data: bytes, sections: Mapping[str, Section], number: int, offset: int) -> Gaussians[FloatArray]:
    """Return the rows of a sound key packet with layers, both together. Raises PacketError."""
    rest = sections["rest"]
    with add_offset(sections["layers"].offset):
        in_first, size, checksum = read_head(sections["layers"].data)
        if size != sections["layout"].offset - SECTION_HEADER.size - offset - _START or in_first > number:
            raise PacketError(f"layers: {in_first} of {number} Gaussians in {size} bytes cannot be")
        if zlib.crc32(data[_START : _START + size]) != checksum:
            raise PacketError("layers: the checksum of the first layer does not match")
    now = decode_rows(sections, in_first)
    with add_offset(rest.offset):
        mask, *parts = unpack_blobs(rest.data, 1 + len(ATTRIBUTES))
        first = _mask(decode_symbols(mask, number, 1)[:, 0], in_first)
        later = decode_rows(
            {name: Section(part, rest.offset) for name, part in zip(ATTRIBUTES, parts, strict=True)}, number - in_first
        )
        if now.shN.shape[1] != later.shN.shape[1]:
            raise PacketError(f"rest: shN of {later.shN.shape[1]} coefficients, the first layer has {now.shN.shape[1]}")
    return Gaussians(**{name: _merged(first, getattr(now, name), getattr(later, name)) for name in ATTRIBUTES})


def first_layer(data: bytes) -> FirstLayer | None:
    """Return the scene in the beginning of a key packet; None when its first layer is incomplete, or without layers.

    Damaged data gives None as well; reading the whole packet raises the error that describes the damage.
    """
    try:
        return _first_layer(data)
    except PacketError:
        return None


def _first_layer(data: bytes) -> FirstLayer | None:
    if len(data) < _START:
        return None
    header = parse_header(data, 0)
    number, length = SECTION_HEADER.unpack_from(data, PACKET_HEADER.size)
    if header.kind != PacketKind.KEY or number != SECTION_IDS["layers"] or length != _LAYERS.size:
        return None
    in_first, size, checksum = read_head(data[_START - _LAYERS.size : _START])
    body = data[_START : _START + size]
    if len(body) < size or in_first > most_gaussians(len(body)) or zlib.crc32(body) != checksum:
        return None
    sections = split_sections(body, len(_VISIBLE), _START)
    if tuple(sections) != _VISIBLE:
        return None
    meta = meta_from_json(decompress(sections["meta"].data, MAX_META))
    return FirstLayer(decode_rows(sections, in_first), meta, header.frame)


def read_head(data: bytes) -> tuple[int, int, int]:
    """Return the contents of section ``layers``: Gaussians of the first layer, bytes of its sections, their CRC-32."""
    if len(data) != _LAYERS.size:
        raise PacketError(f"layers: expected {_LAYERS.size} bytes, got {len(data)}")
    in_first, size, checksum = _LAYERS.unpack(data)
    return in_first, size, checksum


def _mask(marks: np.ndarray, in_first: int) -> BoolArray:
    first: BoolArray = marks == 1
    if not (first | (marks == 0)).all() or int(first.sum()) != in_first:
        raise PacketError(f"rest: {int(first.sum())} Gaussians are marked, the first layer has {in_first}")
    return first


def _merged(first: BoolArray, now: FloatArray, later: FloatArray) -> FloatArray:
    out = np.empty((len(first), *now.shape[1:]), np.float32)
    out[first], out[~first] = now, later
    return out
