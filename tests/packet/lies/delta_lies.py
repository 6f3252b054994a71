"""Deltas that lie: impossible histograms, modes and steps of residuals, counts and rows that are added or removed."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator

import numpy as np
from lying import PAST, Victim
from packet_scenes import begin, make_births, make_delta

from gsstream.core.changes import Delta, RowEdit
from gsstream.core.gaussians import ATTRIBUTES
from gsstream.packet import EncodedPacket, encode_delta
from gsstream.packet.base import parse_packet
from gsstream.packet.bits import BitWriter, pack_blobs, unpack_blobs
from gsstream.packet.changes.rows import HEAD_PARTS
from gsstream.packet.gates import encode_gates
from gsstream.packet.symbols import encode_symbols


def residual_victim() -> Victim:
    """A residual of all rows without decoders."""
    rng = np.random.default_rng(5)
    state = begin(rng, 10, 4)
    packet = encode_delta(make_delta(rng, state.layout, 1.0, 1, latent=False), state.layout, {}, frame=1)
    return Victim(state, packet, _residual_lies(packet))


def _residual_lies(packet: EncodedPacket) -> Iterator[tuple[str, str, bytes, str]]:
    means = parse_packet(packet.data)[1]["means"].data
    for low, bins in ((0, 1 << 30), (2**31 - 2, 100), (-(2**32), 2)):
        head = BitWriter()
        head.bits(1, 1)
        head.signed(low)
        head.gamma(bins - 1)
        head.bits(0, 1)
        data = means[:6] + pack_blobs([head.to_bytes(), b""])
        yield f"{bins} bins from {low}", "means", data, f"histogram of {bins} bins from {low}: expected at most 16384"
    for bits in (-1, 16, 2**31 - 1):  # of four attributes that are sent
        pattern = np.full((10, 1), 15, np.int32)
        pattern[3] = bits
        yield f"pattern {bits}", "pattern", encode_symbols(pattern), "pattern of a row: expected 0 to 15"
    no_decoder, channels = "is unknown, or its decoder was never sent", "channels without a decoder, got"
    heads = [
        (2, 3, 0.1, f"mode 2 {no_decoder}"),
        (1, 3, 0.1, f"mode 1 {no_decoder}"),
        (0, 0, 0.1, f"{channels} 0"),
        (0, 255, 0.1, f"{channels} 255"),
        *((0, 3, step, f"a positive number below 1e6, got {step}") for step in (0.0, math.nan, math.inf, -1.0)),
    ]
    for mode, width, step, message in heads:
        yield f"{width} channels, {mode}, {step}", "means", struct.pack("<BBf", mode, width, step) + means[6:], message


def row_victim() -> Victim:
    """Four added Gaussians, two of them in new nodes, and a removed one."""
    rng = np.random.default_rng(8)
    state = begin(rng)
    delta = Delta().with_row_edit(RowEdit(make_births(rng, state.layout, 4, 2), np.array([1])))
    packet = encode_delta(delta, state.layout, {}, frame=1)
    return Victim(state, packet, _row_lies(packet))


def _head(number: int, new: int) -> bytes:
    head = BitWriter()
    head.gamma(number - 1)
    head.gamma(new)
    return head.to_bytes()


def _row_lies(packet: EncodedPacket) -> Iterator[tuple[str, str, bytes, str]]:
    honest = unpack_blobs(parse_packet(packet.data)[1]["added"].data, HEAD_PARTS + len(ATTRIBUTES))

    def column(*values: int) -> bytes:
        return encode_symbols(np.array(values, np.int32)[:, None])

    for name, part, data, message in (
        ("added Gaussians without end", 0, _head(1 << 30, 2), "1073741824 Gaussians and 2 nodes are beyond the limits"),
        ("nodes without end", 0, _head(4, 1 << 30), "4 Gaussians and 1073741824 nodes are beyond the limits"),
        ("an added Gaussian less", 0, _head(3, 2), "nodes receive 4 Gaussians, 3 were announced"),
        ("a node more", 0, _head(4, 3), "nodes receive 5 Gaussians, 4 were announced"),
        ("no head", 0, b"", "number code without an end, or too large"),
        ("a parent before all", 1, column(-1, 0), "a parent that is no node before its own"),
        ("a parent behind all", 1, column(0, 99), "a parent that is no node before its own"),
        ("no node receives", 2, encode_gates(np.zeros(14, np.uint8), 1), "8 bytes for an empty table"),
        ("all nodes receive", 2, encode_gates(np.ones(14, np.uint8), 3), "receive 15 Gaussians, 4 were announced"),
        ("no nodes", 2, b"", PAST),
        ("no counts", 3, b"", PAST),
        ("no means", 5, b"\0\0\0", PAST),
        ("a unit beyond", 4, column(0, 0, 3, 0), "units 0 to 3, the scene has 3"),
        ("a unit below", 4, column(0, 0, -1, 0), "units -1 to 0, the scene has 3"),
        ("no scales", 7, b"", "scales cut short"),
        ("scales of five", 7, b"\x07\x05", "scales: 5 channels of 7 fractional bits cannot be"),
    ):
        yield name, "added", pack_blobs([data if i == part else old for i, old in enumerate(honest)]), message
    yield "a list of no removed rows", "removed", encode_gates(np.zeros(40, np.uint8), 1), "removed"
    yield "removed rows with levels", "removed", encode_gates(np.full(40, 2, np.uint8), 2), "removed"
