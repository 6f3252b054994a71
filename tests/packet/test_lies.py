"""Streams that lie under correct checksums: impossible counts, grids and values are refused before they cost much."""

from __future__ import annotations

import dataclasses
import struct
import tracemalloc

import numpy as np
import pytest
from packet_scenes import make_delta, make_key, replaced, resealed

from gsstream.core.changes import Layout, Scene
from gsstream.core.errors import PacketError, ShapeError
from gsstream.packet import decode_delta, decode_key, encode_delta, encode_key
from gsstream.packet.base import MAX_GAUSSIANS, parse_packet
from gsstream.packet.bits import BitWriter, pack_blobs
from gsstream.packet.bulk import compress
from gsstream.packet.key import most_gaussians
from gsstream.packet.symbols import encode_symbols


@pytest.mark.usefixtures("bounded_memory")
def test_lying_counts_are_refused_before_allocation():
    key = encode_key(make_key(np.random.default_rng(3), 10, 4))
    many = 0xFFFFFFFF
    liars = {
        "Gaussians": struct.pack("<IIB", many, 4, 3),
        "nodes": struct.pack("<IIB", 10, many, 3),
        "units": struct.pack("<IIB", 10, 4, 255),
        "units cut short": struct.pack("<IIB", 10, 4, 3) + b"\0" * 5,
        "just beyond": struct.pack("<IIB", MAX_GAUSSIANS + 1, 4, 3),
        "more than the bytes can mean": struct.pack("<IIB", most_gaussians(len(key.data) + 20) + 1, 4, 3),
    }
    for what, layout in liars.items():
        with pytest.raises(PacketError):
            decode_key(replaced(key, "layout", layout + b"\0" * 20))
        assert what


@pytest.mark.usefixtures("bounded_memory")
def test_bombs_are_refused_before_inflation():
    key = encode_key(make_key(np.random.default_rng(4), 10, 4))
    bomb = compress(b"\0" * (20 << 20))  # 20 MB of zeros in a few hundred bytes
    tracemalloc.reset_peak()
    start = tracemalloc.get_traced_memory()[0]
    with pytest.raises(PacketError, match="announces"):
        decode_key(replaced(key, "meta", bomb))
    assert tracemalloc.get_traced_memory()[1] - start < 1 << 20


@pytest.mark.usefixtures("bounded_memory")
def test_histograms_beyond_the_limit_are_refused():
    rng = np.random.default_rng(5)
    state = make_key(rng, 10, 4)
    packet = encode_delta(make_delta(rng, state.layout, 1.0, 1, latent=False), state.layout, {}, frame=1)
    prefix = parse_packet(packet.data)[1]["means"].data[:6]
    for low, bins in ((0, 1 << 30), (2**31 - 2, 100), (-(2**32), 2)):
        head = BitWriter()
        head.bits(1, 1)
        head.signed(low)
        head.gamma(bins - 1)
        head.bits(0, 1)
        body = pack_blobs([head.to_bytes(), b""])
        with pytest.raises(PacketError, match="histogram"):
            decode_delta(replaced(packet, "means", prefix + body), Scene(state.gaussians, state.layout), {})


@pytest.mark.parametrize(
    ("mode", "channels", "step"),
    [(2, 3, 0.1), (1, 3, 0.1), (0, 0, 0.1), (0, 255, 0.1), (0, 3, 0.0), (0, 3, np.nan), (0, 3, np.inf), (0, 3, -1.0)],
)
def test_impossible_attribute_headers_are_refused(mode, channels, step):
    rng = np.random.default_rng(6)
    state = make_key(rng, 10, 4)
    packet = encode_delta(make_delta(rng, state.layout, 1.0, 1, latent=False), state.layout, {}, frame=1)
    old = parse_packet(packet.data)[1]["means"].data
    lie = replaced(packet, "means", struct.pack("<BBf", mode, channels, step) + old[6:])
    with pytest.raises(PacketError):
        decode_delta(lie, Scene(state.gaussians, state.layout), {})


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


@pytest.mark.parametrize("meta", [b"", b"[]", b"{}", b"[" * 100_000, b'{"version": NaN}', b"\xff\xfe", b"1" * 5000])
def test_meta_that_is_not_meta_is_refused(meta):
    key = encode_key(make_key(np.random.default_rng(8), 10, 4))
    with pytest.raises(PacketError):
        decode_key(replaced(key, "meta", compress(meta)))


def test_more_equal_gaussians_than_readers_accept_are_not_written():
    number = 400_000
    state = make_key(np.random.default_rng(9), 1, 1)
    rows = np.zeros(number, np.int64)
    layout = Layout(np.int32([number]), np.zeros(number, np.uint8), state.layout.units)
    with pytest.raises(ShapeError, match="Gaussians that differ"):
        encode_key(dataclasses.replace(state, gaussians=state.gaussians.rows(rows), layout=layout))


@pytest.mark.parametrize(
    ("grid", "message"),
    [
        ((-10, 2, 20), "cannot be"), ((5, 2, 4), "cannot be"), ((100, 2, 101), "cannot be"),
        ((-9, 2, -3), "bytes of positions"),
    ],
)  # fmt: skip
def test_impossible_position_grids_are_refused(grid, message):
    key = encode_key(make_key(np.random.default_rng(10), 10, 4))
    old = parse_packet(key.data)[1]["means"].data
    with pytest.raises(PacketError, match=message):
        decode_key(replaced(key, "means", struct.pack("<bbb", *grid) + old[3:]))


def test_impossible_quaternions_are_refused():
    key = encode_key(make_key(np.random.default_rng(11), 3, 2))
    for row in ([4, 0, 0, 0, 0], [0, 0, 0, 0, -128], [0, 120, 100, 90, -60], [0, 1 << 21, 0, 0, 0]):
        table = np.array([[0, 0, 0, 0, 0], row, [0, 0, 0, 0, 0]], np.int32)
        with pytest.raises(PacketError, match="quats"):
            decode_key(replaced(key, "quats", struct.pack("<bB", 7, 4) + encode_symbols(table)))
