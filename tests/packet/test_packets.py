"""Key, delta and empty packets: round trips, the quantisation grid, and what an encoder refuses."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from packet_scenes import decode_all, make_delta, make_key, make_layout, make_meta, make_packets, make_scene, same_bits

from gsstream.core.changes import Delta, Layout, Residual, Scene, apply_delta
from gsstream.core.errors import PacketError, ShapeError
from gsstream.packet import (
    KeyState,
    PacketKind,
    decode_delta,
    decode_key,
    decode_packet,
    encode_delta,
    encode_key,
    positions,
    quantise_decoders,
    quantise_key,
)
from gsstream.packet.base import SECTION_NAMES, parse_packet
from gsstream.packet.grids import KEY_BITS
from gsstream.packet.rows import encode_codes, row_codes

SEEDS = st.integers(0, 2**32 - 1)


@settings(max_examples=40, deadline=None)
@given(SEEDS, st.integers(0, 60), st.sampled_from([0, 3, 8, 15]))
def test_key_round_trip_is_bitwise(seed, number, sh_rest):
    state = make_key(np.random.default_rng(seed), number, sh_rest=sh_rest)
    packet = encode_key(state, frame=5)
    decoded = decode_key(packet.data)
    assert same_bits(decoded.gaussians, quantise_key(state.gaussians))
    assert same_bits(quantise_key(decoded.gaussians), decoded.gaussians)
    assert encode_key(decoded, frame=5).data == packet.data
    for field in dataclasses.fields(Layout):
        assert np.array_equal(getattr(decoded.layout, field.name), getattr(state.layout, field.name))
    assert (packet.kind, packet.frame) == (PacketKind.KEY, 5)


@settings(max_examples=40, deadline=None)
@given(SEEDS, st.floats(1e-6, 1e6))
@example(seed=0, norm=1.0078125)
def test_quantising_twice_is_quantising_once_whatever_the_quaternion_norm(seed, norm):
    scene = make_scene(np.random.default_rng(seed), 20)
    unit = scene.quats / np.linalg.norm(scene.quats, axis=1, keepdims=True)
    once = quantise_key(dataclasses.replace(scene, quats=(unit * norm).astype(np.float32)))
    assert same_bits(quantise_key(once), once)
    cosine = np.abs((once.quats * unit).sum(1)) / np.linalg.norm(once.quats, axis=1)
    assert cosine.min() > 1 - 0.5 * (2.0 ** -KEY_BITS["quats"]) ** 2
    # Norms that are off by less than a quarter step more than rounding explains are left alone (packet.grids).
    assert np.abs(np.linalg.norm(once.quats, axis=1) - 1).max() <= 1.25 * 2.0 ** -KEY_BITS["quats"]


def test_quantisation_error_is_half_a_step():
    scene = make_scene(np.random.default_rng(1), 500, 8)
    unit = scene.quats / np.linalg.norm(scene.quats, axis=1, keepdims=True)
    scene = dataclasses.replace(scene, quats=unit.astype(np.float32))
    sign = np.sign(np.take_along_axis(scene.quats, np.abs(scene.quats).argmax(1)[:, None], 1))
    scene = dataclasses.replace(scene, quats=scene.quats * sign)
    decoded = quantise_key(scene)
    for name, bits in KEY_BITS.items():
        error = np.abs(getattr(decoded, name) - getattr(scene, name)).max()
        # Red = luma + half of both chromas, whose steps are twice as wide: at most four half steps.
        assert 0 < error <= (1.5 if name in ("sh0", "shN") else 0.5) * 2.0**-bits


def test_positions_are_as_fine_as_the_gaussian_is_small():
    scene = make_scene(np.random.default_rng(2), 4000)
    decoded = quantise_key(scene)
    smallest = np.exp(decoded.scales.min(1))
    finest = np.exp(np.median(np.sort(decoded.scales, 1)[:, 1])) / 16
    error = np.abs(decoded.means - scene.means).max(1)
    assert (error <= np.maximum(smallest / 4, finest) / 2 * (1 + 1e-6)).all()
    assert error.max() > finest / 2  # large ones are coarser


@settings(max_examples=60, deadline=None)
@given(SEEDS, st.floats(-12, 6), st.floats(-14, 6), st.integers(1, 40))
def test_positions_round_trip_at_any_scale_and_distance(seed, size, reach, number):
    rng = np.random.default_rng(seed)
    scene = make_scene(rng, number)
    means = (scene.means * 2.0**reach + rng.choice([0, 1000.0]) * 2.0**reach).astype(np.float32)
    scales = (rng.choice([0.1, 8]) * rng.normal(size=(number, 3)) + size).astype(np.float32)
    state = make_key(rng, number)
    state = dataclasses.replace(state, gaussians=dataclasses.replace(scene, means=means, scales=scales))
    try:
        packet = encode_key(state)
    except ShapeError as error:
        assert "diverged" in str(error)  # noqa: PT017
        return
    decoded = decode_key(packet.data).gaussians
    assert same_bits(decoded, quantise_key(state.gaussians))
    assert same_bits(quantise_key(decoded), decoded)


@pytest.mark.parametrize(("number", "reach"), [(3000, 1.0), (3000, 100.0), (30, 1.0)])
def test_positions_take_the_cell_of_the_smallest_packet(number, reach, monkeypatch):
    """Every cell decodes, so nothing but the size says whether the estimate of the cheapest is right."""
    scene = make_scene(np.random.default_rng(6), number)
    scene = dataclasses.replace(scene, means=np.sort(scene.means * np.float32(reach), 0))
    codes, means = row_codes(scene), quantise_key(scene).means
    chosen, candidates = encode_codes(means, codes)["means"], positions._cell_candidates
    sizes = {}
    for cell in candidates(means, int.from_bytes(chosen[:1], signed=True)):
        monkeypatch.setattr(positions, "_cell_candidates", lambda *_, cell=cell: [cell])
        sizes[cell] = len(encode_codes(means, codes)["means"])
    assert len(sizes) > 5
    assert len(chosen) <= 1.02 * min(sizes.values())
    assert max(sizes.values()) > 1.1 * min(sizes.values())


def test_coordinates_too_large_for_their_gaussians_are_refused():
    state = make_key(np.random.default_rng(5))
    state.gaussians.means[3] = 1e30
    with pytest.raises(ShapeError, match="means: expected coordinates below"):
        encode_key(state)


def test_an_empty_and_a_single_gaussian_scene_are_keys():
    for number in (0, 1):
        state = make_key(np.random.default_rng(6), number, nodes=1)
        assert same_bits(decode_key(encode_key(state).data).gaussians, quantise_key(state.gaussians))


def test_a_spatially_sorted_scene_costs_a_sixth_of_its_floats():
    rng = np.random.default_rng(7)
    number = 5000
    scene = make_scene(rng, number, 8)
    surface = np.sort(rng.random(number)) * 20
    means = np.column_stack([surface, np.sin(surface), 0.05 * rng.normal(size=number)]).astype(np.float32)
    scales, shN = (scene.scales - 1).astype(np.float32), (0.3 * scene.shN).astype(np.float32)
    scene = dataclasses.replace(scene, means=means, scales=scales, shN=shN)
    layout = Layout(np.ones(number, np.int32), np.zeros(number, np.uint8), np.float32([1]))
    packet = encode_key(KeyState(scene, layout, make_meta()))
    raw = sum(array.nbytes for _, array in scene.items())
    assert len(packet.data) < raw / 6


def test_meta_round_trip_keeps_every_bit():
    meta = make_meta()
    state = dataclasses.replace(make_key(np.random.default_rng(2)), meta=meta)
    decoded = decode_key(encode_key(state).data).meta
    for split in ("train", "test"):
        a, b = getattr(meta, split), getattr(decoded, split)
        assert (a.ids, a.width, a.height, a.near_plane) == (b.ids, b.width, b.height, b.near_plane)
        assert a.viewmats.tobytes() == b.viewmats.tobytes()
        assert a.Ks.tobytes() == b.Ks.tobytes()
    assert dataclasses.replace(decoded, train=meta.train, test=meta.test) == meta
    assert decoded.recipe_hash == meta.recipe_hash


def test_key_refuses_a_layout_of_another_scene():
    rng = np.random.default_rng(4)
    with pytest.raises(ShapeError, match="layout"):
        encode_key(KeyState(make_scene(rng, 40), make_layout(rng, 41, 5), make_meta()))


@settings(max_examples=60, deadline=None)
@given(SEEDS, st.integers(0, 50), st.integers(1, 20), st.floats(0, 1), st.integers(1, 255), st.booleans())
def test_delta_round_trip(seed, number, nodes, share, levels, latent):
    rng = np.random.default_rng(seed)
    state = make_key(rng, number, nodes)
    delta = make_delta(rng, state.layout, share, levels, latent)
    packet = encode_delta(delta, state.layout, {}, frame=1)
    scene = Scene(quantise_key(state.gaussians), state.layout)
    decoded = decode_delta(packet.data, scene, {})
    found, sent = decoded.residual, delta.residual
    assert decoded.changes == (found,)
    assert np.array_equal(found.gates, sent.gates)
    assert found.num_levels == levels
    assert set(found.symbols) == set(sent.symbols)
    for name in sent.symbols:
        assert np.array_equal(found.symbols[name], sent.symbols[name])
        assert np.float32(found.steps[name]) == np.float32(sent.steps[name])
    for name in sent.decoders:
        assert found.decoders[name].tobytes() == sent.decoders[name].tobytes()
    assert same_bits(apply_delta(scene, decoded).gaussians, apply_delta(scene, delta).gaussians)


def test_sizes_account_for_every_byte():
    for packet in make_packets():
        _, sections = parse_packet(packet.data)
        assert sum(packet.sizes.values()) == len(packet.data)
        assert {n: len(s.data) for n, s in sections.items()} == {n: v for n, v in packet.sizes.items() if n != "header"}
        assert packet.sizes["header"] == 16 + 5 * len(sections)
        assert set(packet.sizes) <= {*SECTION_NAMES.values(), "header"}


def test_decoders_are_sent_only_when_they_change():
    rng = np.random.default_rng(5)
    state = make_key(rng)
    delta = make_delta(rng, state.layout)
    first = encode_delta(delta, state.layout, {}, frame=1)
    decoders = delta.residual.decoders
    again = encode_delta(delta, state.layout, decoders, frame=2)
    assert "decoders" in first.sizes
    assert "decoders" not in again.sizes
    scene = Scene(quantise_key(state.gaussians), state.layout)
    decoded = decode_delta(again.data, scene, decoders)
    assert decoded.residual.decoders["sh0"].tobytes() == decoders["sh0"].tobytes()
    with pytest.raises(PacketError, match="never sent"):
        decode_delta(again.data, scene, {})


def test_a_key_packet_forgets_the_decoders():
    packets = make_packets(frames=6, key_at=4)
    assert decode_all(packets)[4].decoders == {}
    assert "decoders" in packets[5].sizes


def test_decoder_rounding_is_idempotent_and_refuses_overflow():
    once = quantise_decoders({"sh0": np.random.default_rng(6).normal(size=(2, 3)) * 100})
    assert quantise_decoders(once)["sh0"].tobytes() == once["sh0"].tobytes()
    with pytest.raises(ShapeError, match="diverged"):
        quantise_decoders({"sh0": np.full((1, 3), 1e6)})


def _broken_deltas():
    rng = np.random.default_rng(7)
    state = make_key(rng)
    delta = make_delta(rng, state.layout).residual
    rows = delta.symbols["means"].shape[0]
    change = dataclasses.replace
    yield state.layout, change(delta, gates=delta.gates[:-1]), "gates"
    yield state.layout, change(delta, gates=np.full_like(delta.gates, 9)), "symbols|gates"
    short = {**delta.symbols, "means": delta.symbols["means"][:-1]}
    yield state.layout, change(delta, symbols=short), "symbols of means"
    yield state.layout, change(delta, symbols={**delta.symbols, "means": np.zeros((rows, 2), np.int32)}), "channels"
    yield state.layout, change(delta, symbols={**delta.symbols, "means": np.zeros((rows, 3), np.int64)}), "int32"
    yield state.layout, change(delta, steps={}), "step"
    yield state.layout, change(delta, steps={**delta.steps, "means": 0.0}), "step of means"
    yield state.layout, change(delta, steps={**delta.steps, "means": float("nan")}), "step of means"
    yield state.layout, change(delta, decoders={"sh0": np.full((2, 3), 1 / 3, np.float32)}), "quantise_decoders"
    yield state.layout, change(delta, decoders={"scales": np.zeros((3, 3), np.float32)}), "decoders"
    yield state.layout, change(delta, symbols={**delta.symbols, "colour": delta.symbols["means"]}), "colour"


@pytest.mark.parametrize("case", range(11))
def test_encoder_refuses_deltas_that_do_not_fit(case):
    layout, residual, message = list(_broken_deltas())[case]
    with pytest.raises(ShapeError, match=message):
        encode_delta(Delta((residual,)), layout, {}, frame=1)


def test_a_delta_of_another_scene_is_refused():
    rng = np.random.default_rng(8)
    first, second = make_key(rng, 40, 12, 3), make_key(rng, 40, 12, 8)
    rows = int(first.layout.node_counts.sum())
    delta = Delta((Residual(np.ones(12, np.uint8), 1, {"shN": np.ones((rows, 9), np.int32)}, {"shN": 0.1}),))
    packet = encode_delta(delta, first.layout, {}, frame=1)
    state = decode_packet(None, encode_key(second).data)
    with pytest.raises(PacketError) as caught:
        decode_packet(state, packet.data, offset=123)
    assert caught.value.offset == 123
