"""Whole Gaussians as integers: the attribute sections of a key packet, and the added Gaussians of a delta packet."""

from __future__ import annotations

import struct
from collections.abc import Mapping

from gsstream.core.errors import PacketError
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.packet.base import WIDTHS, Section, add_offset
from gsstream.packet.grids import KEY_BITS, MAX_BITS, MAX_CODE, fold_quats, from_codes, to_codes, unfold_quats
from gsstream.packet.positions import decode_positions, encode_positions, quantise_positions
from gsstream.packet.symbols import decode_symbols, encode_symbols

_FIXED = struct.Struct("<bB")


def row_codes(gaussians: Gaussians[FloatArray]) -> dict[str, IntArray]:
    """Return attribute -> [N, width] int32 fixed-point codes; positions have none. Raises ShapeError for bad values."""
    return {name: to_codes(name, getattr(gaussians, name), bits) for name, bits in KEY_BITS.items()}


def decoded_rows(gaussians: Gaussians[FloatArray], codes: Mapping[str, IntArray]) -> Gaussians[FloatArray]:
    """Return the values that a decoder reads from :func:`encode_rows`, float32."""
    out = {name: _shaped(name, from_codes(name, table, KEY_BITS[name])) for name, table in codes.items()}
    out["means"] = quantise_positions(gaussians.means, codes["scales"], KEY_BITS["scales"])
    return Gaussians(**out)


def encode_rows(gaussians: Gaussians[FloatArray]) -> dict[str, bytes]:
    """Quantise rows and return attribute -> payload, positions first; the reader must know N."""
    codes = row_codes(gaussians)
    return encode_codes(decoded_rows(gaussians, codes).means, codes)


def encode_codes(means: FloatArray, codes: Mapping[str, IntArray], floor: int | None = None) -> dict[str, bytes]:
    """Return attribute -> payload of rows that are quantised already, positions first."""
    out = {"means": encode_positions(means, codes["scales"], KEY_BITS["scales"], floor)}
    for name, table in codes.items():
        head = _FIXED.pack(KEY_BITS[name], table.shape[1])
        out[name] = head + encode_symbols(fold_quats(table, KEY_BITS[name]) if name == "quats" else table)
    return out


def decode_rows(sections: Mapping[str, Section], number: int) -> Gaussians[FloatArray]:
    """Decode ``number`` rows that :func:`encode_rows` wrote. Raises PacketError with the offset of the section."""
    arrays: dict[str, FloatArray] = {}
    for name in KEY_BITS:
        with add_offset(sections[name].offset):
            codes, bits = _decode_codes(name, sections[name].data, number)
            arrays[name] = _shaped(name, from_codes(name, codes, bits))
        if name == "scales":
            with add_offset(sections["means"].offset):
                arrays["means"] = decode_positions(sections["means"].data, codes, bits)
    return Gaussians(**arrays)


def _shaped(name: str, flat: FloatArray) -> FloatArray:
    """[N, width] in the shape of the attribute."""
    number, width = flat.shape
    shapes = {"opacities": (number,), "sh0": (number, 1, 3), "shN": (number, width // 3, 3)}
    return flat.reshape(shapes.get(name, (number, width)))


def _decode_codes(name: str, data: bytes, number: int) -> tuple[IntArray, int]:
    """[N, width] int32 codes of an attribute and their fractional bits."""
    if len(data) < _FIXED.size:
        raise PacketError(f"{name} cut short")
    bits, width = _FIXED.unpack_from(data)
    if width not in WIDTHS[name] or not 1 <= bits <= MAX_BITS:
        raise PacketError(f"{name}: {width} channels of {bits} fractional bits cannot be")
    payload = data[_FIXED.size :]
    if name == "quats":
        return unfold_quats(decode_symbols(payload, number, width + 1), bits), bits
    codes = decode_symbols(payload, number, width)
    if codes.size and max(int(codes.max()), -int(codes.min())) >= MAX_CODE:
        raise PacketError(f"{name}: code out of range")
    return codes, bits
