"""Motions that lie: numbers of them, flags, cells, groups and symbols that cannot be."""

from __future__ import annotations

import struct
from collections.abc import Iterator

import numpy as np
from lying import LEFT, PAST, Victim
from packet_scenes import moving_state

from gsstream.core.changes import Delta
from gsstream.packet import EncodedPacket, PlayerState, encode_delta
from gsstream.packet.base import parse_packet
from gsstream.packet.bits import pack_blobs, unpack_blobs
from gsstream.packet.gates import encode_gates
from gsstream.packet.symbols import encode_symbols

HEAD = struct.Struct("<BBfff")


def motion_victim() -> Victim:
    """A motion of some groups, predicted from the frame before."""
    state, delta = moving_state()
    packet = encode_delta(delta, state.layout, {}, frame=2)
    return Victim(state, packet, ((name, "motion", data, text) for name, data, text in _lies(state, delta, packet)))


def _lies(state: PlayerState, delta: Delta, packet: EncodedPacket) -> Iterator[tuple[str, bytes, str]]:
    """A number of motions, then those, one after the other."""
    data = parse_packet(packet.data)[1]["motion"].data
    for number in (0, 9, 255):
        yield f"{number} motions", bytes([number]) + data[1:], f"expected 1 to 8 motions, got {number}"
        yield f"{number} motions and none there", bytes([number]), f"expected 1 to 8 motions, got {number}"
    yield "two motions, one there", b"\2" + data[1:], "motion cut short"
    yield "two motions, none there", b"\2", PAST
    yield "nothing", b"", "expected 1 to 8 motions, got 0"
    for name, motion, text in _lying_motions(state, delta, data[1:]):
        yield name, b"\1" + motion, text


def _lying_motions(state: PlayerState, delta: Delta, data: bytes) -> Iterator[tuple[str, bytes, str]]:
    head, (gates, symbols) = data[: HEAD.size], unpack_blobs(data[HEAD.size :], 2)
    flags, bins, cell, shift, turn = HEAD.unpack(head)
    tail, count = pack_blobs([gates, symbols]), state.scene.groups.count
    moving = int(delta.motions[0].moving.sum())

    def headed(*fields: float) -> bytes:
        return HEAD.pack(*fields) + tail

    nan, inf = float("nan"), float("inf")
    for bits in (4, 8, 128, 255):
        yield f"flags {bits}", headed(bits, bins, cell, shift, turn), "unknown flags"
    for wrong in (0, 17, 255):
        yield f"{wrong} brightness_bins", headed(flags, wrong, cell, shift, turn), "brightness_bins: expected 1 to 16"
    for wrong in (0.0, -0.0, -1.0, nan, inf, -inf, 1e9):
        yield f"cell {wrong}", headed(flags, bins, wrong, shift, turn), "cell: expected a float32 above 0"
        yield f"shift step {wrong}", headed(flags, bins, cell, wrong, turn), "translation_step: expected a float32"
        yield f"turn step {wrong}", headed(flags, bins, cell, shift, wrong), "rotation_step: expected a float32"
    yield "other cells", headed(flags, bins, cell * 100, shift, turn), "gate runs cover more than the 15 nodes"
    every = (np.arange(count + 1) % 2).astype(np.uint8)
    yield "one group more", head + pack_blobs([encode_gates(every, 1), symbols]), "gates: 1 levels in"
    few = encode_gates((np.arange(count + 50) == count + 40).astype(np.uint8), 1)
    yield "runs beyond the groups", head + pack_blobs([few, b""]), "gate"
    yield "levels", head + pack_blobs([encode_gates(np.full(count, 2, np.uint8), 2), symbols]), "no levels"
    yield "no symbols", head + pack_blobs([gates, b""]), PAST
    yield (
        "symbols of one group more",
        head + pack_blobs([gates, encode_symbols(np.arange(6 * moving + 6, dtype=np.int32).reshape(-1, 6))]),
        LEFT,
    )
    none = encode_gates(np.zeros(count, np.uint8), 1)
    yield "nothing moves, but symbols", head + pack_blobs([none, symbols]), "empty table"
    large = encode_symbols(np.full((moving, 6), 2**31 - 1, np.int32))
    over = HEAD.pack(flags, bins, cell, 9e8, turn)
    yield "a shift that overflows", over + pack_blobs([gates, large]), "cannot be"
    over = HEAD.pack(flags, bins, cell, shift, 9e8)
    yield "a turn that overflows", over + pack_blobs([gates, large]), "cannot be"
    for cut in range(HEAD.size):
        yield f"cut after {cut} bytes", head[:cut], "motion cut short"
    yield "cut after the head", head, PAST
    yield "a byte more", head + tail + b"\0", "expected a multiple of 4 bytes, got 49"
