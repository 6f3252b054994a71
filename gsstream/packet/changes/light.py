"""The light of a delta packet: section light, three factors of binary16."""

from __future__ import annotations

import struct

from gsstream.core.changes import Light
from gsstream.core.errors import PacketError, ShapeError
from gsstream.packet.base import Section, add_offset

_FACTORS = struct.Struct("<3e")


def encode_light(light: Light) -> list[tuple[str, bytes]]:
    """Return the section that holds a light. Raises ShapeError for factors that cannot be sent."""
    if problem := light.problem():
        raise ShapeError(f"light: {problem}")
    return [("light", _FACTORS.pack(*light.factor))]


def decode_light(section: Section) -> Light:
    """Return the light of a frame. Raises PacketError."""
    with add_offset(section.offset):
        if len(section.data) != _FACTORS.size:
            raise PacketError(f"light: expected {_FACTORS.size} bytes, got {len(section.data)}")
        red, green, blue = _FACTORS.unpack(section.data)
        light = Light((red, green, blue))
        if problem := light.problem():
            raise PacketError(f"light: {problem}")
    return light
