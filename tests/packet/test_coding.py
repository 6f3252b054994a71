"""Bit fields, symbol tables, gates and patterns: what goes in comes out, and it costs what theory says."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from packet_scenes import make_delta, make_key, replaced

from gsstream.core.changes import Delta, Residual, Scene
from gsstream.core.errors import PacketError, ShapeError
from gsstream.packet import decode_delta, encode_delta
from gsstream.packet.bits import BitReader, BitWriter, compress, decompress, pack_blobs, unpack_blobs
from gsstream.packet.gates import decode_gates, encode_gates
from gsstream.packet.symbols import _histogram, decode_symbols, encode_symbols

INT32 = st.integers(-(2**31), 2**31 - 1)


def entropy_bytes(column: np.ndarray) -> float:
    """Order-0 entropy, bytes."""
    _, counts = np.unique(column, return_counts=True)
    return float(-(counts * np.log2(counts / counts.sum())).sum() / 8)


@given(hnp.arrays(np.int64, st.integers(1, 60), elements=st.integers(-9, 9) | INT32))
def test_histogram_is_numpys(column):
    for got, wanted in zip(_histogram(column), np.unique(column, return_counts=True), strict=True):
        np.testing.assert_array_equal(got, wanted)


@given(st.lists(st.tuples(st.sampled_from("bgs"), st.integers(0, 2**33)), max_size=60))
def test_bit_fields_round_trip(fields):
    writer = BitWriter()
    for kind, value in fields:
        {"b": lambda v: writer.bits(v & 0xFF, 8), "g": writer.gamma, "s": lambda v: writer.signed(-v)}[kind](value)
    reader = BitReader(writer.to_bytes())
    for kind, value in fields:
        read = {"b": lambda: reader.bits(8), "g": reader.gamma, "s": reader.signed}[kind]()
        assert read == {"b": value & 0xFF, "g": value, "s": -value}[kind]
    reader.finish()


def test_bit_reader_refuses_overruns_and_leftovers():
    with pytest.raises(PacketError):
        BitReader(b"\x00").bits(9)
    with pytest.raises(PacketError):
        BitReader(b"\x00" * 100).gamma()
    with pytest.raises(PacketError):
        BitReader(b"\x80\x00").finish()
    with pytest.raises(PacketError):
        BitReader(b"\x01").finish()


@given(st.lists(st.binary(max_size=300), min_size=1, max_size=5))
def test_blobs_round_trip(blobs):
    assert unpack_blobs(pack_blobs(blobs), len(blobs)) == blobs


@settings(max_examples=150)
@given(
    hnp.arrays(
        np.int32,
        st.tuples(st.integers(0, 60), st.integers(0, 5)),
        elements=st.one_of(st.integers(-3, 3), st.integers(-500, 500), INT32),
    )
)
def test_symbols_round_trip(table):
    data = encode_symbols(table)
    decoded = decode_symbols(data, *table.shape)
    assert decoded.dtype == np.int32
    assert np.array_equal(decoded, table)


@pytest.mark.parametrize("scale", [0.3, 1.0, 4.0, 30.0])
def test_large_tables_cost_their_entropy(scale):
    rng = np.random.default_rng(3)
    table = np.rint(rng.laplace(size=(40_000, 3)) * scale * [1, 2, 4]).astype(np.int32)
    size, bound = len(encode_symbols(table)), sum(entropy_bytes(column) for column in table.T)
    header = sum(len(np.unique(column)) for column in table.T)  # about a byte per bin at most
    assert bound - 8 <= size <= 1.005 * bound + header + 60


def test_one_model_is_shared_when_that_is_smaller():
    rng = np.random.default_rng(4)
    table = np.rint(rng.laplace(size=(30, 24)) * 3).astype(np.int32)
    alone = sum(len(encode_symbols(table[:, [i]])) for i in range(24))
    assert len(encode_symbols(table)) < 0.6 * alone


def test_constant_channels_cost_no_payload():
    assert len(encode_symbols(np.full((100_000, 9), -7, np.int32))) <= 4


@settings(max_examples=150)
@given(st.integers(1, 255), st.data())
def test_gates_round_trip(levels, data):
    gates = data.draw(hnp.arrays(np.uint8, st.integers(0, 200), elements=st.one_of(st.just(0), st.integers(0, levels))))
    decoded, decoded_levels = decode_gates(encode_gates(gates, levels), len(gates))
    assert decoded_levels == levels
    assert np.array_equal(decoded, gates)


@pytest.mark.parametrize(("share", "bound"), [(0.0, 8), (0.001, 200), (1.0, 8)])
def test_sparse_gates_cost_follows_change(share, bound):
    gates = (np.random.default_rng(6).random(100_000) < share).astype(np.uint8)
    assert len(encode_gates(gates, 1)) <= bound


@pytest.mark.parametrize("share", [0.01, 0.1, 0.5])
def test_random_gates_cost_their_entropy(share):
    gates = (np.random.default_rng(7).random(50_000) < share).astype(np.uint8)
    assert len(encode_gates(gates, 1)) <= 1.04 * entropy_bytes(gates) + 60


def test_clustered_gates_cost_less_than_their_entropy():
    gates = np.repeat((np.random.default_rng(8).random(500) < 0.2).astype(np.uint8), 100)
    assert len(encode_gates(gates, 1)) < 0.05 * entropy_bytes(gates)


@pytest.mark.parametrize(("gates", "levels"), [([3], 2), ([1], 0), ([1], 256), ([[1]], 1)])
def test_impossible_gates_are_refused(gates, levels):
    with pytest.raises(ShapeError):
        encode_gates(np.array(gates), levels)


@given(st.binary(max_size=400))
def test_bulk_round_trip(data):
    assert decompress(compress(data), 400) == data


def test_bulk_refuses_sizes_before_allocating():
    bomb = compress(bytes(10_000_000))
    assert len(bomb) < 1000
    with pytest.raises(PacketError, match="announces"):
        decompress(bomb, 1000)
    with pytest.raises(PacketError):
        decompress(bomb[:-3], 20_000_000)
    with pytest.raises(PacketError):
        decompress(bomb + b"x", 20_000_000)


def scene(seed: int = 0) -> Scene:
    state = make_key(np.random.default_rng(seed), 40, 9)
    return Scene(state.gaussians, state.layout)


@given(st.integers(0, 2**32 - 1), st.floats(0, 1))
@settings(max_examples=40, deadline=None)
def test_every_table_comes_back_zeros_and_all(seed: int, share: float) -> None:
    rng, before = np.random.default_rng(seed), scene()
    gates = (rng.random(9) < 0.7).astype(np.uint8)
    rows = int(before.layout.node_counts[gates != 0].sum())
    widths = {"means": 3, "opacities": 1, "sh0": 3}
    symbols = {
        name: (rng.integers(-3, 4, (rows, width)) * (rng.random((rows, 1)) < share)).astype(np.int32)
        for name, width in widths.items()
    }
    residual = Residual(gates, 1, symbols, dict.fromkeys(widths, 0.5), {})
    packet = encode_delta(Delta().with_residual(residual), before.layout, {}, frame=1)
    found = decode_delta(packet.data, before, {}).residual
    assert found is not None
    for name in widths:
        np.testing.assert_array_equal(found.symbols[name], symbols[name], strict=True)


def test_rows_of_zeros_cost_next_to_nothing() -> None:
    """Nine attributes of ten rows that do not change: their zeros would cost more than all that changes."""
    rng = np.random.default_rng(1)
    state = make_key(rng, 4000, 9)
    symbols = {name: rng.integers(-8, 9, (4000, 3)).astype(np.int32) for name in ("means", "scales", "sh0")}
    kept = rng.random(4000) < 0.05
    for table in symbols.values():
        table[~kept] = 0
    residual = Residual(np.ones(9, np.uint8), 1, symbols, dict.fromkeys(symbols, 0.5), {})
    sizes = encode_delta(Delta().with_residual(residual), state.layout, {}, frame=1).sizes
    with_pattern = sum(sizes[name] for name in ("pattern", *symbols))
    assert with_pattern < 0.7 * sum(len(encode_symbols(table)) for table in symbols.values())


def test_a_pattern_that_asks_for_other_rows_than_are_there_is_refused() -> None:
    before = scene()
    delta = make_delta(np.random.default_rng(2), before.layout, 1.0, 1, latent=False)
    packet = encode_delta(delta, before.layout, {}, frame=1)
    rows = len(delta.residual.symbols["means"])
    with pytest.raises(PacketError):
        decode_delta(replaced(packet, "pattern", encode_symbols(np.zeros((rows, 1), np.int32))), before, {})
