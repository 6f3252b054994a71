"""Delta packets: an ordered list of changes, each with its own sections. Empty packets: nothing changed."""

from __future__ import annotations

import operator
from collections.abc import Mapping

from gsstream.core.changes import Delta, Layout, Light, Motion, Scene, apply_light
from gsstream.core.errors import PacketError, ShapeError
from gsstream.core.gaussians import ATTRIBUTES
from gsstream.core.shapes import FloatArray
from gsstream.packet.base import EncodedPacket, PacketKind, Section, add_offset, build_packet, expect
from gsstream.packet.changes.field import decode_field, encode_field
from gsstream.packet.changes.light import decode_light, encode_light
from gsstream.packet.changes.motion import decode_motions, encode_motions
from gsstream.packet.changes.residual import decode_residual, encode_residual
from gsstream.packet.changes.rows import decode_rows_change, encode_rows_change

#: Sections of a delta packet in the order in which they stand there.
SECTIONS = ("light", "motion", "field", "gates", "pattern", "decoders", *ATTRIBUTES, "removed", "added")


def next_decoders(previous: Mapping[str, FloatArray], delta: Delta) -> dict[str, FloatArray]:
    """Return ``previous_decoders`` of the packet after this delta. After a key packet it is ``{}``."""
    return {**previous, **({} if delta.residual is None else delta.residual.decoders)}


def encode_empty(*, frame: int) -> EncodedPacket:
    """Return the packet of a frame in which nothing changes: 16 bytes."""
    return build_packet(PacketKind.EMPTY, frame, [])


#: Cache of :func:`encode_motions`: the motions of a packet, and the sections that they were encoded to.
KnownMotions = tuple[tuple[Motion, ...], list[tuple[str, bytes]]]


def encode_delta(
    delta: Delta,
    layout: Layout,
    previous_decoders: Mapping[str, FloatArray],
    *,
    frame: int,
    known: KnownMotions | None = None,
) -> EncodedPacket:
    """Encode one frame's changes.

    Raises ShapeError when a change does not fit the layout, or when there is none: that is an empty packet.
    """
    sections = [] if delta.light is None else encode_light(delta.light)
    sections += _motion_sections(delta.motions, known)
    if delta.field is not None:
        sections += encode_field(delta.field)
    if delta.residual is not None:
        sections += encode_residual(delta.residual, layout, previous_decoders)
    if delta.row_edit is not None:
        sections += encode_rows_change(delta.row_edit, layout)
    if not sections:
        raise ShapeError("delta: expected at least one change, got none; encode_empty makes the packet of such a frame")
    return build_packet(PacketKind.DELTA, frame, sections)


def _motion_sections(motions: tuple[Motion, ...], known: KnownMotions | None) -> list[tuple[str, bytes]]:
    if known is not None and len(motions) == len(known[0]) and all(map(operator.is_, motions, known[0])):
        return list(known[1])
    return encode_motions(motions)


def decode_delta(data: bytes, scene: Scene, previous_decoders: Mapping[str, FloatArray], *, offset: int = 0) -> Delta:
    """Decode a complete delta packet. Raises PacketError with the byte offset."""
    _, sections = expect(data, offset, PacketKind.DELTA)
    _check_sections(sections, offset)
    light = decode_light(sections["light"]) if "light" in sections else None
    if light is not None:
        with add_offset(sections["light"].offset):
            scene = _lit(scene, light)  # motions form groups by brightness
    motions = decode_motions(sections["motion"], scene) if "motion" in sections else ()
    field = decode_field(sections["field"], scene, motions) if "field" in sections else None
    residual = decode_residual(sections, scene.layout, previous_decoders)
    rows = decode_rows_change(sections, scene.layout)
    changes = (light, *motions, field, residual, rows)
    return Delta(tuple(change for change in changes if change is not None))


def _lit(scene: Scene, light: Light) -> Scene:
    try:
        return apply_light(scene, light)
    except ShapeError as error:
        raise PacketError(str(error)) from error


def _check_sections(sections: Mapping[str, Section], offset: int) -> None:
    known = [name for name in SECTIONS if name in sections]
    if not known or list(sections) != known:
        raise PacketError(f"delta packet: sections {', '.join(sections) or 'none'} do not stand in this order", offset)


def decode_empty(data: bytes, *, offset: int = 0) -> None:
    """Check a complete empty packet. Raises PacketError."""
    _, sections = expect(data, offset, PacketKind.EMPTY)
    if sections:
        raise PacketError("empty packet with sections", offset)
