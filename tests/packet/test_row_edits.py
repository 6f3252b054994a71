"""Added and removed Gaussians: round trips, where rows go, what is refused, and what the limits hold off."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from packet_scenes import decode_all, make_births, make_edit, make_key, make_packets, make_scene, same_bits

from gsstream.core.changes import (
    AddedGaussians,
    Delta,
    Layout,
    Residual,
    RowEdit,
    add_as_nodes,
    add_to_nodes,
    apply_delta,
    row_gates,
)
from gsstream.core.errors import PacketError, ShapeError
from gsstream.evaluation.stream_stats import stream_stats
from gsstream.packet import (
    StreamWriter,
    decode_delta,
    decode_packet,
    encode_delta,
    encode_key,
    quantise_key,
)
from gsstream.packet.changes.rows import max_added_in

SEEDS = st.integers(0, 2**32 - 1)
NONE = np.zeros(0, np.int64)


def closed(births: AddedGaussians | None = None, deaths=NONE) -> Delta:
    return Delta().with_row_edit(RowEdit(births, deaths))


def first_state(rng, number=40, nodes=12, sh_rest=3):
    return decode_packet(None, encode_key(make_key(rng, number, nodes, sh_rest)).data)


def naive(state, delta):
    """Rows of the next scene as (node, unit, values), one Gaussian at a time, in plain Python."""
    moved = apply_delta(state.scene, delta.with_row_edit(None)).gaussians
    gone = set(delta.removed.tolist())
    table = [
        (int(node), int(unit), tuple(value[i].tobytes() for _, value in moved.items()))
        for i, (node, unit) in enumerate(zip(state.layout.node_of, state.layout.unit_of, strict=True))
        if i not in gone
    ]
    if delta.added is not None:
        coded = quantise_key(delta.added.gaussians)
        table += [
            (int(node), int(unit), tuple(value[i].tobytes() for _, value in coded.items()))
            for i, (node, unit) in enumerate(zip(delta.added.nodes, delta.added.unit_of, strict=True))
        ]
    return sorted(table, key=lambda row: row[0])  # stable: old rows first within a node


@settings(max_examples=80, deadline=None)
@given(
    SEEDS,
    st.integers(0, 40),
    st.integers(1, 12),
    st.integers(0, 30),
    st.sampled_from([0.0, 0.2, 1.0]),
    st.sampled_from([0, 3, 8, 15]),
)
def test_a_decoded_edit_is_what_plain_python_makes_of_it(seed, number, nodes, births, deaths, sh_rest):
    rng = np.random.default_rng(seed)
    state = first_state(rng, number, nodes, sh_rest)
    delta = make_edit(rng, state, births, deaths)
    packet = encode_delta(delta, state.layout, {}, frame=1)
    after = decode_packet(state, packet.data)
    assert naive(state, delta) == [
        (int(node), int(unit), tuple(value[i].tobytes() for _, value in after.gaussians.items()))
        for i, (node, unit) in enumerate(zip(after.layout.node_of, after.layout.unit_of, strict=True))
    ]
    assert encode_delta(after.delta, state.layout, {}, frame=1).data == packet.data
    assert np.array_equal(after.delta.removed, delta.removed)
    if births:
        for name in ("nodes", "unit_of", "parents"):
            assert np.array_equal(getattr(after.delta.added, name), getattr(delta.added, name)), name
    assert int(after.layout.node_counts.sum()) == len(after.gaussians) == len(row_gates(state.layout, delta))
    after.gaussians.validate()


@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_a_stream_of_edits_never_loses_track(seed):
    rng = np.random.default_rng(seed)
    state = first_state(rng)
    for frame in range(1, 7):
        delta = make_edit(rng, state, int(rng.integers(0, 5)), 0.1)
        state = decode_packet(state, encode_delta(delta, state.layout, state.decoders, frame=frame).data)
        assert len(state.layout.unit_of) == len(state.gaussians)
    key = encode_key(make_key(rng))  # the layout that grew is still one a key packet can hold
    again = dataclasses.replace(make_key(rng), gaussians=state.gaussians, layout=state.layout)
    assert len(encode_key(again).data) > 0 < len(key.data)


def test_births_and_deaths_alone_are_a_packet():
    state = first_state(np.random.default_rng(1))
    for delta in (
        closed(deaths=np.array([3])),
        closed(add_to_nodes(make_scene(np.random.default_rng(2), 2), [4, 1], [0, 1])),
    ):
        assert not delta.is_empty
        after = decode_packet(state, encode_delta(delta, state.layout, {}, frame=1).data)
        assert len(after.gaussians) == len(after.layout.unit_of) != 40


def test_everything_may_leave_and_something_come_again():
    state = first_state(np.random.default_rng(3))
    nothing = closed(deaths=np.arange(40))
    state = decode_packet(state, encode_delta(nothing, state.layout, {}, frame=1).data)
    assert len(state.gaussians) == 0
    assert len(state.layout.node_counts) == 12
    added = add_as_nodes(make_scene(np.random.default_rng(4), 5), np.zeros(5), 12)
    state = decode_packet(state, encode_delta(closed(added), state.layout, {}, frame=2).data)
    assert same_bits(state.gaussians, quantise_key(added.gaussians))
    assert state.layout.node_counts.tolist() == [0] * 12 + [1] * 5


def _unfit():
    rng = np.random.default_rng(5)
    state = first_state(rng)
    added = make_births(rng, state.layout, 4, 2)
    change = dataclasses.replace
    yield state, change(added, nodes=added.nodes[::-1].copy()), NONE, "ascending"
    yield state, change(added, nodes=np.array([0, 1, 2, 14])), NONE, "nodes from 0 to 13"
    yield state, change(added, parents=np.array([12, 14])), NONE, "parent"
    yield state, change(added, parents=np.array([-1, 0])), NONE, "parent"
    yield state, change(added, unit_of=np.full(4, 3, np.uint8)), NONE, "expected units 0 to 2"
    yield state, change(added, unit_of=np.zeros(3, np.uint8)), NONE, "units like nodes"
    yield state, None, np.array([4, 4]), "removed"
    yield state, None, np.array([5, 4]), "removed"
    yield state, None, np.array([40]), "removed"
    yield state, AddedGaussians(added.gaussians.rows(NONE), NONE, NONE.astype(np.uint8), NONE), NONE, "at least 1"
    bad = change(added.gaussians, means=np.full((4, 3), np.nan, np.float32))
    yield state, change(added, gaussians=bad), NONE, "finite"


@pytest.mark.parametrize("case", range(11))
def test_encoder_refuses_edits_that_do_not_fit(case):
    state, added, removed, message = list(_unfit())[case]
    with pytest.raises(ShapeError, match=message):
        encode_delta(closed(added, removed), state.layout, {}, frame=1)


def test_births_of_another_degree_are_refused_with_the_packets_offset():
    rng = np.random.default_rng(6)
    state = first_state(rng, sh_rest=3)
    packet = encode_delta(closed(make_births(rng, state.layout, 2, 0, 8)), state.layout, {}, frame=1)
    with pytest.raises(PacketError, match="shN") as caught:
        decode_packet(state, packet.data, offset=99)
    assert caught.value.offset == 99


def test_births_are_refused_once_most_of_them_are_equal():
    rng = np.random.default_rng(7)
    state = first_state(rng)
    many = add_to_nodes(make_scene(rng, 1).rows(np.zeros(200_000, np.int64)), np.zeros(200_000), np.zeros(200_000))
    with pytest.raises(ShapeError, match="Gaussians that differ"):
        encode_delta(closed(many), state.layout, {}, frame=1)


def test_a_scene_cannot_grow_beyond_the_limit(monkeypatch):
    rng = np.random.default_rng(9)
    state = first_state(rng)
    packet = encode_delta(closed(make_births(rng, state.layout, 4, 2)), state.layout, {}, frame=1)
    monkeypatch.setattr("gsstream.packet.changes.rows.MAX_GAUSSIANS", 43)
    with pytest.raises(PacketError, match="beyond the limits"):
        decode_delta(packet.data, state.scene, {})
    monkeypatch.setattr("gsstream.packet.changes.rows.MAX_GAUSSIANS", 44)
    assert len(decode_delta(packet.data, state.scene, {}).added) == 4
    monkeypatch.undo()
    assert max_added_in(10) == 640


def test_gates_are_shown_on_the_rows_they_moved():
    state = first_state(np.random.default_rng(11), 6, 2)
    layout = Layout(np.int32([4, 2]), state.layout.unit_of, state.layout.units)
    added = add_to_nodes(make_scene(np.random.default_rng(12), 1), [0], [0])
    delta = Delta((Residual(np.uint8([0, 2]), 4), RowEdit(added, np.array([0, 5]))))
    assert row_gates(layout, delta).tolist() == [0, 0, 0, 1, 0.5]


def test_costs_of_births_are_accounted_for(tmp_path):
    packets = make_packets(seed=13, number=60, nodes=20, edits=(1, 3), frames=4, key_at=9)
    with StreamWriter.open(tmp_path / "s.gss") as writer:
        for packet in packets:
            writer.append(packet)
    stats = stream_stats(tmp_path / "s.gss")
    assert stats.sections("delta")["added"] == sum(p.sizes.get("added", 0) for p in packets) > 0
    for found, state in zip(stats.packets, decode_all(packets), strict=True):
        assert found.coded >= found.entropy * 0.99 if found.kind != "empty" else found.coded == 0
        assert (found.float16_zstd > 0) == (state.delta is not None or found.kind == "key")
    assert stats.num_gaussians == len(decode_all(packets)[-1].gaussians)
