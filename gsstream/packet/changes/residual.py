"""The residual of a delta packet: sections gates, pattern, decoders and the attributes that change."""

from __future__ import annotations

import struct
from collections.abc import Mapping

import numpy as np

from gsstream.core.changes import Layout, Residual
from gsstream.core.errors import PacketError, ShapeError
from gsstream.core.gaussians import ATTRIBUTES
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.packet.base import (
    MAX_CHANNELS,
    WIDTHS,
    Section,
    add_offset,
)
from gsstream.packet.gates import decode_gates, encode_gates
from gsstream.packet.symbols import decode_symbols, encode_symbols

_ATTRIBUTE = struct.Struct("<BBf")
_DECODER = struct.Struct("<BBB")
_DIRECT, _LATENT = 0, 1
#: Products of symbol, step and decoder beyond this are refused: they could not be added to a float32 scene.
_MAX_CHANGE = 1e18


def quantise_decoders(decoders: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Return the float32 decoders a player will have: rounded to float16.

    Doing it again changes nothing. Raises ShapeError beyond +-65504.
    """
    out: dict[str, FloatArray] = {}
    for name, value in decoders.items():
        with np.errstate(over="ignore"):
            half = np.asarray(value, np.float32).astype(np.float16)
        if not np.isfinite(half).all():
            raise ShapeError(f"decoder of {name}: expected finite values within +-65504; the optimisation has diverged")
        out[name] = half.astype(np.float32)
    return out


def encode_residual(
    residual: Residual, layout: Layout, previous_decoders: Mapping[str, FloatArray]
) -> list[tuple[str, bytes]]:
    """Return the sections of a residual, in order. Raises ShapeError when the residual does not fit the layout."""
    _check_residual(residual, layout)
    sections = [("gates", encode_gates(np.asarray(residual.gates), residual.num_levels))]
    decoders = residual.decoders
    sent = [n for n in ATTRIBUTES if n in decoders and not _same(decoders[n], previous_decoders.get(n))]
    if sent:
        sections.append(("decoders", b"".join(_encode_decoder(name, decoders[name]) for name in sent)))
    names = [name for name in ATTRIBUTES if name in residual.symbols]
    if not names:
        return sections
    pattern = pattern_of(residual.symbols, names)
    sections.insert(1, ("pattern", encode_pattern(pattern)))
    for bit, name in enumerate(names):
        symbols = residual.symbols[name]
        mode = _LATENT if name in decoders else _DIRECT
        head = _ATTRIBUTE.pack(mode, symbols.shape[1], residual.steps[name])
        sections.append((name, head + encode_symbols(symbols[(pattern >> bit & 1) != 0])))
    return sections


def decode_residual(
    sections: Mapping[str, Section], layout: Layout, previous_decoders: Mapping[str, FloatArray]
) -> Residual | None:
    """Return the residual that the sections of a delta packet hold, if they hold one. Raises PacketError."""
    if "gates" not in sections:
        strange = [name for name in ("pattern", "decoders", *ATTRIBUTES) if name in sections]
        if strange:
            raise PacketError(f"delta packet: section {strange[0]} without gates", sections[strange[0]].offset)
        return None
    with add_offset(sections["gates"].offset):
        gates, num_levels = decode_gates(sections["gates"].data, len(layout.node_counts))
    rows = int(np.asarray(layout.node_counts)[gates != 0].sum())
    known = dict(previous_decoders)
    sent: dict[str, FloatArray] = {}
    if "decoders" in sections:
        with add_offset(sections["decoders"].offset):
            sent = _decode_decoders(sections["decoders"])
    known.update(sent)
    symbols, steps, decoders = {}, {}, {}
    names = [name for name in ATTRIBUTES if name in sections]
    pattern = None
    if "pattern" in sections:
        with add_offset(sections["pattern"].offset):
            pattern = decode_pattern(sections["pattern"].data, rows, len(names))
    for bit, name in enumerate(names):
        with add_offset(sections[name].offset):
            number = rows if pattern is None else int(np.count_nonzero(pattern >> bit & 1))
            table, steps[name], mode = _decode_attribute(name, sections[name].data, number, known)
            symbols[name] = table if pattern is None else spread(table, pattern, bit)
        if mode == _LATENT:
            decoders[name] = known[name]
    if not set(sent) <= set(decoders):
        raise PacketError("delta packet: a decoder is sent that no attribute uses", sections["decoders"].offset)
    return Residual(gates=gates, num_levels=num_levels, symbols=symbols, steps=steps, decoders=decoders)


def _check_residual(residual: Residual, layout: Layout) -> None:
    if len(residual.gates) != len(layout.node_counts):
        raise ShapeError(f"gates: expected {len(layout.node_counts)} (one per node), got {len(residual.gates)}")
    rows = int(np.asarray(layout.node_counts)[np.asarray(residual.gates) != 0].sum())
    unknown = set(residual.symbols) - set(ATTRIBUTES)
    if unknown or set(residual.symbols) - set(residual.steps) or set(residual.decoders) - set(residual.symbols):
        raise ShapeError(
            "residual: expected symbols and a step per attribute, decoders only where symbols are; got symbols of "
            f"{sorted(residual.symbols)}, steps of {sorted(residual.steps)}, decoders of {sorted(residual.decoders)}"
        )
    for name, table in residual.symbols.items():
        if table.ndim != 2 or table.shape[0] != rows or not 1 <= table.shape[1] <= MAX_CHANNELS:
            raise ShapeError(f"symbols of {name}: expected [{rows}, 1..{MAX_CHANNELS}], got {list(table.shape)}")
        if table.dtype != np.int32:
            raise ShapeError(f"symbols of {name}: expected int32, got {table.dtype}")
        problem = _misfit(name, table.shape[1], float(np.float32(residual.steps[name])), residual.decoders.get(name))
        if problem:
            raise ShapeError(problem)
    rounded = quantise_decoders(residual.decoders)
    for name, decoder in residual.decoders.items():
        if decoder.dtype != np.float32 or not _same(decoder, rounded[name]):
            raise ShapeError(f"decoder of {name}: expected float32 values from quantise_decoders(), got others")


def _misfit(name: str, channels: int, step: float, decoder: FloatArray | None) -> str | None:
    """Why an attribute's channels, step and decoder do not go together; None when they do."""
    if not (0 < step < 1e6):
        return f"step of {name}: expected a positive number below 1e6, got {step}"
    if decoder is None:
        if channels not in WIDTHS[name]:
            return f"symbols of {name}: expected {WIDTHS[name]} channels without a decoder, got {channels}"
        return None
    if decoder.ndim != 2 or decoder.shape[0] != channels or decoder.shape[1] not in WIDTHS[name]:
        return f"decoder of {name}: expected [{channels}, {WIDTHS[name]}], got {list(decoder.shape)}"
    return None


def _same(decoder: FloatArray, other: FloatArray | None) -> bool:
    # Bytes, not values: -0 and +0 decode to different bits.
    return other is not None and decoder.shape == other.shape and decoder.tobytes() == other.tobytes()


def _encode_decoder(name: str, decoder: FloatArray) -> bytes:
    return _DECODER.pack(ATTRIBUTES.index(name), *decoder.shape) + decoder.astype("<f2").tobytes()


def _decode_decoders(section: Section) -> dict[str, FloatArray]:
    out: dict[str, FloatArray] = {}
    data, at = section.data, 0
    while at < len(data):
        if at + _DECODER.size > len(data):
            raise PacketError("decoder header cut short")
        index, latents, width = _DECODER.unpack_from(data, at)
        at += _DECODER.size
        size = 2 * latents * width
        if index >= len(ATTRIBUTES) or ATTRIBUTES[index] in out or not 1 <= latents <= MAX_CHANNELS:
            raise PacketError(f"decoder of attribute {index} with {latents} latents is repeated or cannot be")
        if width not in WIDTHS[ATTRIBUTES[index]] or width == 0 or size > len(data) - at:
            raise PacketError(f"decoder of {ATTRIBUTES[index]}: {latents} x {width} does not fit the section")
        values = np.frombuffer(data[at : at + size], "<f2").astype(np.float32).reshape(latents, width)
        if not np.isfinite(values).all():
            raise PacketError(f"decoder of {ATTRIBUTES[index]}: a value is not finite")
        out[ATTRIBUTES[index]] = values
        at += size
    return out


def _decode_attribute(
    name: str, data: bytes, rows: int, known: Mapping[str, FloatArray]
) -> tuple[IntArray, float, int]:
    if len(data) < _ATTRIBUTE.size:
        raise PacketError(f"{name} cut short")
    mode, channels, step = _ATTRIBUTE.unpack_from(data)
    if mode not in (_DIRECT, _LATENT) or (mode == _LATENT and name not in known):
        raise PacketError(f"{name}: mode {mode} is unknown, or its decoder was never sent")
    decoder = known[name] if mode == _LATENT else None
    problem = _misfit(name, channels, step, decoder)
    if problem or channels == 0:
        raise PacketError(problem or f"{name}: no channels")
    symbols = decode_symbols(data[_ATTRIBUTE.size :], rows, channels)
    largest = float(np.abs(symbols.astype(np.float64)).max()) if symbols.size else 0.0
    gain = 1.0 if decoder is None else channels * float(np.abs(decoder).max())
    if largest * step * gain > _MAX_CHANGE:
        raise PacketError(f"{name}: a residual of {largest * step * gain:g} cannot be")
    return symbols, step, mode


# Which attributes of a sent row change is one number a row, so that zero rows of an attribute cost no symbols. About
# half of the rows behind open gates change nothing, and of the others few change in all attributes. The number of a row
# holds all of that at once, and its histogram what the attributes have in common.


def pattern_of(symbols: Mapping[str, IntArray], names: list[str]) -> IntArray:
    """Return [A] int32: bit i of a row is set where attribute ``names[i]`` has a symbol that is not zero."""
    out = np.zeros(len(symbols[names[0]]), np.int32)
    for bit, name in enumerate(names):
        out |= symbols[name].any(1).astype(np.int32) << bit
    return out


def encode_pattern(pattern: IntArray) -> bytes:
    """Encode the numbers [A] of :func:`pattern_of`; the reader must know A."""
    return encode_symbols(pattern[:, None])


def decode_pattern(data: bytes, rows: int, attributes: int) -> IntArray:
    """Decode the numbers [rows] of :func:`pattern_of`.

    Raises PacketError (without offset) for a number beyond them, or where no attribute is sent.
    """
    if attributes == 0:
        raise PacketError("pattern of rows without an attribute that changes")
    pattern = decode_symbols(data, rows, 1)[:, 0]
    if pattern.size and (int(pattern.min()) < 0 or int(pattern.max()) >= 1 << attributes):
        raise PacketError(f"pattern of a row: expected 0 to {(1 << attributes) - 1} for {attributes} attributes")
    return pattern


def spread(table: IntArray, pattern: IntArray, bit: int) -> IntArray:
    """Return [A, L]: the rows of a table at the rows of the pattern that have the bit; zeros elsewhere."""
    out = np.zeros((len(pattern), table.shape[1]), np.int32)
    out[(pattern >> bit & 1) != 0] = table
    return out
