"""What sections say together cannot overflow a scene, and what no reader accepts is not written."""

from __future__ import annotations

import dataclasses
import struct

import numpy as np
import pytest
from packet_scenes import make_delta, make_key, resealed

from gsstream.core.changes import Layout, Scene
from gsstream.core.errors import PacketError, ShapeError
from gsstream.packet import decode_delta, encode_delta, encode_key
from gsstream.packet.base import parse_packet


def test_huge_residuals_cannot_overflow_the_scene():
    rng = np.random.default_rng(7)
    state = make_key(rng, 10, 4)
    delta = make_delta(rng, state.layout, 1.0, 1, latent=True)
    delta.residual.symbols["sh0"][:] = 2**31 - 1
    packet = encode_delta(delta, state.layout, {}, frame=1)
    old = parse_packet(packet.data)[1]
    large = {
        "decoders": old["decoders"].data[:3] + np.full(6, 60_000, "<f2").tobytes(),
        "sh0": struct.pack("<BBf", 1, 2, 9e5) + old["sh0"].data[6:],
    }
    huge = resealed(packet, lambda name, data: large.get(name, data))
    with pytest.raises(PacketError, match="cannot be"):
        decode_delta(huge, Scene(state.gaussians, state.layout), {})


def test_more_equal_gaussians_than_readers_accept_are_not_written():
    number = 400_000
    state = make_key(np.random.default_rng(9), 1, 1)
    rows = np.zeros(number, np.int64)
    layout = Layout(np.int32([number]), np.zeros(number, np.uint8), state.layout.units)
    with pytest.raises(ShapeError, match="Gaussians that differ"):
        encode_key(dataclasses.replace(state, gaussians=state.gaussians.rows(rows), layout=layout))
