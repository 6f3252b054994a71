"""Fields that lie: shapes, boxes, marks and symbols that cannot be."""

from __future__ import annotations

import struct
from collections.abc import Iterator

import numpy as np
from lying import LEFT, PAST, Victim
from packet_scenes import begin, make_field

from gsstream.core.changes import Delta, Field
from gsstream.packet import EncodedPacket, PlayerState, encode_delta
from gsstream.packet.base import parse_packet
from gsstream.packet.bits import pack_blobs, unpack_blobs
from gsstream.packet.gates import encode_gates
from gsstream.packet.symbols import encode_symbols

HEAD = struct.Struct("<BBBBBBHIII8f")
NAMES = (
    "flags", "levels", "entries", "features", "width", "layers", "base", "seed", "entry step", "weight step", "growth",
    "reach", "low x", "low y", "low z", "high x", "high y", "high z",
)  # fmt: skip


def field_victim() -> Victim:
    """A field over some of 30 Gaussians."""
    rng = np.random.default_rng(8)
    state = begin(rng, 30, 9)
    field = make_field(rng, state.scene, 0.7, 9)
    packet = encode_delta(Delta((field,)), state.layout, {}, frame=1)
    return Victim(state, packet, ((name, "field", data, text) for name, data, text in _lies(state, field, packet)))


def _lies(state: PlayerState, field: Field, packet: EncodedPacket) -> Iterator[tuple[str, bytes, str]]:
    data = parse_packet(packet.data)[1]["field"].data
    head, parts = list(HEAD.unpack(data[: HEAD.size])), unpack_blobs(data[HEAD.size :], 7)
    tail, number = pack_blobs(parts), len(state.gaussians)
    nan, inf = float("nan"), float("inf")

    def headed(**said: float) -> bytes:
        fields = dict(zip(NAMES, head, strict=True)) | {name.replace("_", " "): value for name, value in said.items()}
        return HEAD.pack(*fields.values()) + tail

    def parted(at: int, part: bytes) -> bytes:
        return HEAD.pack(*head) + pack_blobs([part if i == at else old for i, old in enumerate(parts)])

    for bits in (2, 4, 128, 255):
        yield f"flags {bits}", headed(flags=bits), "unknown flags"
    yield "marks, though none are said", headed(flags=0), "marks of rows"
    for name, most in (("levels", 16), ("entries", 20), ("features", 8), ("width", 128), ("layers", 4), ("base", 1024)):
        for wrong in (0, most + 1):
            yield f"{name} {wrong}", headed(**{name: wrong}), f"{name}: expected 1 to {most}"
    for name, most in (("entry", 1 << 25), ("weight", 1 << 17)):
        for wrong in (0, most + 1, 2**32 - 1):
            yield f"{name} step {wrong}", headed(**{f"{name}_step": wrong}), f"step of {name} symbols"
        yield f"the largest {name} step", headed(**{f"{name}_step": most}), "units in size"
    for wrong in (nan, inf, -1.0, 0.0, 4.5):
        yield f"growth {wrong}", headed(growth=wrong), "growth: expected a float32 from 1 to 4"
    for wrong in (nan, inf, 0.0, -0.0, -1.0, 1e9):
        yield f"reach {wrong}", headed(reach=wrong), "reach: expected"
    for wrong in (nan, inf, -inf, 2.0):
        yield f"box from {wrong}", headed(low_y=wrong), "box: expected"
    yield "an empty box", headed(high_z=head[NAMES.index("low z")]), "box: expected"
    yield "too many entries", headed(levels=16, entries=17), "at most 1048576 in all levels"
    announced = "part of 2000431 bytes announced, 17 left"
    yield "more levels and features", headed(levels=16, entries=4, features=8, layers=1), announced
    yield "cells without end", headed(levels=12, base=1024, growth=4.0), "cells along an axis"
    yield "another box", headed(low_x=-0.1), LEFT
    yield "more layers", headed(layers=4), announced
    yield "no marks", parted(0, b""), PAST
    yield "marks with levels", parted(0, encode_gates(np.full(number, 2, np.uint8), 2)), "no levels"
    yield "marks of more rows", parted(0, encode_gates((np.arange(number + 1) % 2).astype(np.uint8), 1)), "gates"
    other = encode_gates((np.arange(number) < 2).astype(np.uint8), 1)
    yield "other marks", parted(0, other), "49 bytes for an empty table"
    rows = len(field.entries[0])
    for at in (1, 2, 3):
        yield f"no entries in part {at}", parted(at, b""), PAST
    yield "an entry more", parted(1, encode_symbols(np.arange(2 * rows + 2, dtype=np.int32).reshape(-1, 2))), LEFT
    beyond = encode_symbols(np.full((rows, 2), 1 << 11, np.int32))
    yield "entries beyond", parted(1, beyond), "entries of level 0: expected below"
    yield "weights beyond", parted(4, encode_symbols(np.full((6, 5), -(2**31), np.int32))), "layer 0: expected below"
    yield "a layer of another form", parted(5, encode_symbols(np.eye(6, dtype=np.int32))), LEFT
    for cut in range(0, HEAD.size, 7):
        yield f"cut after {cut} bytes", (HEAD.pack(*head))[:cut], "field cut short"
    yield "cut after the head", HEAD.pack(*head), PAST
    yield "a byte more", HEAD.pack(*head) + tail + b"\0", "expected a multiple of 4 bytes, got 21"
