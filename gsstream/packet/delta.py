"""Delta packets: gates, residual symbols of the rows behind open gates, births and deaths. Empty: nothing changed."""

from __future__ import annotations

import struct
from collections.abc import Mapping

import numpy as np

from gsstream.core.births import Births, check_births, check_deaths
from gsstream.core.delta import Delta, Layout
from gsstream.core.errors import PacketError, ShapeError
from gsstream.core.gaussians import ATTRIBUTES
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.packet.base import (
    MAX_CHANNELS,
    MAX_GAUSSIANS,
    WIDTHS,
    EncodedPacket,
    PacketKind,
    Section,
    build_packet,
    expect,
    located,
)  # fmt: skip
from gsstream.packet.births import decode_births, decode_deaths, encode_births, encode_deaths
from gsstream.packet.gates import decode_gates, encode_gates
from gsstream.packet.symbols import decode_symbols, encode_symbols

_ATTRIBUTE = struct.Struct("<BBf")
_DECODER = struct.Struct("<BBB")
_DIRECT, _LATENT = 0, 1
#: Products of symbol, step and decoder beyond this are refused: they could not be added to a float32 scene.
_MAX_CHANGE = 1e18


def quantise_decoders(decoders: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """The float32 decoders a player will have: rounded to float16. Idempotent. Raises ShapeError beyond +-65504."""
    out: dict[str, FloatArray] = {}
    for name, value in decoders.items():
        with np.errstate(over="ignore"):
            half = np.asarray(value, np.float32).astype(np.float16)
        if not np.isfinite(half).all():
            raise ShapeError(f"decoder of {name}: expected finite values within +-65504; the optimisation has diverged")
        out[name] = half.astype(np.float32)
    return out


def next_decoders(previous: Mapping[str, FloatArray], delta: Delta) -> dict[str, FloatArray]:
    """``previous_decoders`` of the packet after this delta. After a key packet it is ``{}``."""
    return {**previous, **delta.decoders}


def encode_empty(*, frame: int) -> EncodedPacket:
    """A frame in which nothing changes: 16 bytes."""
    return build_packet(PacketKind.EMPTY, frame, [])


def encode_delta(
    delta: Delta, layout: Layout, previous_decoders: Mapping[str, FloatArray], *, frame: int
) -> EncodedPacket:
    """Encode one frame's change.

    Arguments:
        delta: its decoders must come from :func:`quantise_decoders`.
        layout: that of the frame before.
        previous_decoders: the decoders last sent since the last key packet (:func:`next_decoders`).

    Raises ShapeError when the delta does not fit the layout.
    """
    _check_delta(delta, layout)
    sections = [("gates", encode_gates(np.asarray(delta.gates), delta.num_levels))]
    sent = [n for n in ATTRIBUTES if n in delta.decoders and not _same(delta.decoders[n], previous_decoders.get(n))]
    if sent:
        sections.append(("decoders", b"".join(_encode_decoder(name, delta.decoders[name]) for name in sent)))
    for name in ATTRIBUTES:
        if name in delta.symbols:
            symbols = delta.symbols[name]
            mode = _LATENT if name in delta.decoders else _DIRECT
            head = _ATTRIBUTE.pack(mode, symbols.shape[1], delta.steps[name])
            sections.append((name, head + encode_symbols(symbols)))
    if len(delta.deaths):
        sections.append(("deaths", encode_deaths(delta.deaths, len(layout.octree_levels))))
    if delta.births is not None:
        sections.append(("births", encode_births(delta.births, len(layout.node_counts))))
    return build_packet(PacketKind.DELTA, frame, sections)


def decode_delta(
    data: bytes, layout: Layout, previous_decoders: Mapping[str, FloatArray], *, offset: int = 0
) -> Delta:
    """Decode a complete delta packet; the arguments are those of :func:`encode_delta`. Raises PacketError."""
    _, sections = expect(data, offset, PacketKind.DELTA)
    if "gates" not in sections or not set(sections) <= {"gates", "decoders", *ATTRIBUTES, "deaths", "births"}:
        raise PacketError(f"delta packet: unexpected sections {sorted(sections)}", offset)
    with located(sections["gates"].offset):
        gates, num_levels = decode_gates(sections["gates"].data, len(layout.node_counts))
    rows = int(np.asarray(layout.node_counts)[gates != 0].sum())
    known = dict(previous_decoders)
    sent: dict[str, FloatArray] = {}
    if "decoders" in sections:
        with located(sections["decoders"].offset):
            sent = _decode_decoders(sections["decoders"])
    known.update(sent)
    symbols, steps, decoders = {}, {}, {}
    for name in ATTRIBUTES:
        if name in sections:
            with located(sections[name].offset):
                symbols[name], steps[name], mode = _decode_attribute(name, sections[name].data, rows, known)
            if mode == _LATENT:
                decoders[name] = known[name]
    if not set(sent) <= set(decoders):
        raise PacketError("delta packet: a decoder is sent that no attribute uses", sections["decoders"].offset)
    deaths, births = _decode_edit(sections, layout)
    return Delta(gates, num_levels, symbols, steps, decoders, births, deaths)


def _decode_edit(sections: Mapping[str, Section], layout: Layout) -> tuple[IntArray, Births | None]:
    """Rows that leave, and what is born."""
    number = len(layout.octree_levels)
    deaths: IntArray = np.zeros(0, np.int64)
    if "deaths" in sections:
        with located(sections["deaths"].offset):
            deaths = decode_deaths(sections["deaths"].data, number)
    if "births" not in sections:
        return deaths, None
    most = MAX_GAUSSIANS - (number - len(deaths))
    with located(sections["births"].offset):
        return deaths, decode_births(sections["births"], len(layout.node_counts), len(layout.cell_sizes), most)


def decode_empty(data: bytes, *, offset: int = 0) -> None:
    """Check a complete empty packet. Raises PacketError."""
    _, sections = expect(data, offset, PacketKind.EMPTY)
    if sections:
        raise PacketError("empty packet with sections", offset)


def _check_delta(delta: Delta, layout: Layout) -> None:
    if len(delta.gates) != len(layout.node_counts):
        raise ShapeError(f"gates: expected {len(layout.node_counts)} (one per node), got {len(delta.gates)}")
    rows = int(np.asarray(layout.node_counts)[np.asarray(delta.gates) != 0].sum())
    unknown = set(delta.symbols) - set(ATTRIBUTES)
    if unknown or set(delta.symbols) - set(delta.steps) or set(delta.decoders) - set(delta.symbols):
        raise ShapeError(
            "delta: expected symbols and a step per attribute, decoders only where there are symbols; got symbols of "
            f"{sorted(delta.symbols)}, steps of {sorted(delta.steps)}, decoders of {sorted(delta.decoders)}"
        )
    for name, table in delta.symbols.items():
        if table.ndim != 2 or table.shape[0] != rows or not 1 <= table.shape[1] <= MAX_CHANNELS:
            raise ShapeError(f"symbols of {name}: expected [{rows}, 1..{MAX_CHANNELS}], got {list(table.shape)}")
        if table.dtype != np.int32:
            raise ShapeError(f"symbols of {name}: expected int32, got {table.dtype}")
        problem = _misfit(name, table.shape[1], float(np.float32(delta.steps[name])), delta.decoders.get(name))
        if problem:
            raise ShapeError(problem)
    check_deaths(delta.deaths, len(layout.octree_levels))
    if delta.births is not None:
        _check_births(delta.births, layout, len(delta.deaths))
    rounded = quantise_decoders(delta.decoders)
    for name, decoder in delta.decoders.items():
        if decoder.dtype != np.float32 or not _same(decoder, rounded[name]):
            raise ShapeError(f"decoder of {name}: expected float32 values from quantise_decoders(), got others")


def _check_births(births: Births, layout: Layout, leaving: int) -> None:
    births.gaussians.validate()
    check_births(births, len(layout.node_counts), len(layout.cell_sizes), [])
    after = len(layout.octree_levels) - leaving + len(births)
    nodes = len(layout.node_counts) + len(births.parents)
    if len(births) == 0 or after > MAX_GAUSSIANS or nodes > MAX_GAUSSIANS:
        raise ShapeError(
            f"births: expected at least 1, and at most {MAX_GAUSSIANS} Gaussians and nodes afterwards, got "
            f"{len(births)}, {after} and {nodes}; without any leave births None"
        )


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
