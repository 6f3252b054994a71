"""Motions in packets: round trips, a second decoder written from the text, pinned bits."""

from __future__ import annotations

import dataclasses
import itertools
import warnings
from dataclasses import replace

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st
from make_samples import digest
from motion_oracle import World
from packet_scenes import (
    begin,
    decode_all,
    follow,
    make_delta,
    make_edit,
    make_key,
    make_motion,
    make_motions,
    make_moving_packets,
    make_scene,
    same_bits,
    write_stream,
)

from gsstream.core.changes import (
    Delta,
    Displacement,
    Layout,
    Motion,
    Residual,
    RowEdit,
    Scene,
    add_as_nodes,
    apply_delta,
    apply_motion,
    apply_residual,
    gather_rows,
    groups_for,
    sent_rows,
)
from gsstream.evaluation.stream_stats import stream_stats
from gsstream.packet import (
    KeyState,
    PlayerState,
    decode_delta,
    decode_packet,
    encode_delta,
    encode_empty,
    encode_key,
)
from gsstream.packet.changes.motion import encode_motions
from gsstream.packet.state import MOST_SKIPPED
from gsstream.player.playback import Playback

SEEDS = st.integers(0, 2**32 - 1)


def random_frame(rng: np.random.Generator, state: PlayerState, reach: float) -> Delta | None:
    """Up to three motions of any kind, then perhaps a residual, added and removed Gaussians; None: an empty packet."""
    if rng.random() < 0.15:
        return None
    scene, motions = state.scene, []
    for _ in range(int(rng.integers(0, 4))):
        cell = float(np.float32(reach * rng.choice([0.01, 0.7, 2.0, 1e4])))
        motion = make_motion(
            rng,
            scene,
            cell,
            int(rng.choice([1, 2, 16])),
            float(rng.choice([0.0, 0.5, 1.0])),
            predicted=bool(rng.random() < 0.7),
            regroup=bool(rng.random() < 0.3),
        )
        if motions and rng.random() < 0.5:  # the groups of the one before, once more
            last = motions[-1]
            moving = last.moving * (rng.random(len(last.moving)) < 0.5).astype(np.uint8)
            symbols = rng.integers(-9, 10, (int(moving.sum()), 6)).astype(np.int32)
            motion = dataclasses.replace(last, moving=moving, symbols=symbols, regroup=False)
        motion = dataclasses.replace(motion, rotation_step=float(np.float32(rng.choice([0.01, 0.3, 40.0]))))
        scene, _ = apply_motion(scene, motion)
        motions.append(motion)
    rest: tuple[Residual | RowEdit, ...] = ()
    if rng.random() < 0.5:
        rest = make_delta(rng, state.layout).changes
    if rng.random() < 0.4:
        rest = make_edit(rng, state, int(rng.integers(0, 5)), float(rng.choice([0.1, 1.0], p=[0.8, 0.2]))).changes
    delta = Delta((*motions, *rest))
    return delta if motions or not delta.is_empty else None


def oracle_step(world: World, state: PlayerState, after: PlayerState) -> None:
    """Step the oracle with what the packet said. Values of residual and added Gaussians are taken as they are."""
    if after.delta is None:
        world.moved = {}
        return
    means, quats = [list(row) for row in world.means], [list(row) for row in world.quats]
    touched: set[int] = set()
    for motion in after.delta.motions:
        touched |= world.move(motion)
    if after.delta.residual is not None:
        gaussians = dataclasses.replace(
            state.gaussians,
            means=np.array(world.means, np.float32).reshape(-1, 3),
            quats=np.array(world.quats, np.float32).reshape(-1, 4),
        )
        changed = apply_residual(gaussians, state.layout, after.delta.residual)
        world.means, world.quats = changed.means.tolist(), changed.quats.tolist()
        world.sh0 = changed.sh0[:, 0].tolist()
        touched |= set(sent_rows(state.layout, after.delta.residual.gates).tolist())
    world.displaced(means, quats, touched)
    if after.delta.has_row_edit:
        source = gather_rows(state.layout.node_of, after.delta.added, after.delta.removed).tolist()
        tables = [world.means, world.quats, world.sh0]
        if after.delta.added is not None:
            added = World.of(after.delta.added.gaussians)
            tables = [world.means + added.means, world.quats + added.quats, world.sh0 + added.sh0]
        world.edit(source, *([table[row] for row in source] for table in tables))


def check_equal(world: World, state: PlayerState) -> None:
    """Bit for bit: centres, quaternions, groups, displacements."""
    number = len(state.gaussians)
    assert np.array(world.means, np.float32).reshape(number, 3).tobytes() == state.gaussians.means.tobytes()
    assert np.array(world.quats, np.float32).reshape(number, 4).tobytes() == state.gaussians.quats.tobytes()
    groups, moved = state.scene.groups, state.scene.displacement
    if world.named is None:
        assert groups is None
    else:
        assert (groups.cell, groups.brightness_bins) == world.named
        assert (groups.group_of.tolist(), groups.count) == (world.group_of, world.count)
    found = (
        {}
        if moved is None
        else {
            row: (translation.tolist(), rotation.tolist())
            for row, translation, rotation in zip(moved.rows.tolist(), moved.translation, moved.rotation, strict=True)
        }
    )
    assert found == world.moved


@settings(max_examples=60, deadline=None)
@given(SEEDS, st.integers(0, 30), st.sampled_from([1.0, 1e-3, 1e4]))
@example(0, 0, 1.0)
@example(1, 1, 1.0)
def test_a_decoder_written_from_the_text_reaches_the_same_bits(seed, number, reach):
    rng = np.random.default_rng(seed)
    state = begin(rng, number, 6, reach)
    world = World.of(state.gaussians)
    for _ in range(6):
        delta = random_frame(rng, state, reach)
        before = state
        if delta is None:
            state = decode_packet(state, encode_empty(frame=state.frame + 1).data)
        else:
            state = follow(state, delta)
        oracle_step(world, before, state)
        check_equal(world, state)


def test_the_oracle_reads_the_stored_sample():
    """Every form of motion, also those that random frames make seldom."""
    packets = make_moving_packets(seed=12, number=30, nodes=9)
    states = decode_all(packets)
    world = World.of(states[0].gaussians)
    for before, after in itertools.pairwise(states):
        oracle_step(world, before, after)
        check_equal(world, after)


@settings(max_examples=60, deadline=None)
@given(SEEDS, st.integers(0, 60), st.integers(1, 8), st.booleans(), st.booleans())
def test_motions_round_trip(seed, number, motions, predicted, regroup):
    rng = np.random.default_rng(seed)
    state = begin(rng, number)
    delta = make_motions(rng, state.scene, motions, predicted=predicted, regroup=regroup)
    packet = encode_delta(delta, state.layout, {}, frame=1)
    found = decode_delta(packet.data, state.scene, {})
    assert len(found.motions) == motions
    for sent, got in zip(delta.motions, found.motions, strict=True):
        for name in ("cell", "brightness_bins", "translation_step", "rotation_step", "predicted", "regroup"):
            assert getattr(got, name) == getattr(sent, name), name
        assert got.moving.tolist() == sent.moving.tolist()
        assert got.symbols.dtype == np.int32
        assert got.symbols.tolist() == sent.symbols.tolist()
    assert encode_delta(found, state.layout, {}, frame=1).data == packet.data
    assert same_bits(apply_delta(state.scene, found).gaussians, apply_delta(state.scene, delta).gaussians)
    assert packet.sizes["motion"] + packet.sizes["header"] == len(packet.data)


def test_a_stream_of_motions_plays_in_any_order_and_is_measured(tmp_path):
    packets = make_moving_packets(seed=3, number=50, nodes=12)
    write_stream(tmp_path / "s.gss", packets)
    states = decode_all(packets)
    with Playback(tmp_path / "s.gss") as playback:
        for frame in (9, 0, 5, 5, 2, 8, 1, 4, 9):
            assert same_bits(playback.state_at(frame), states[frame].gaussians)
    stats = stream_stats(tmp_path / "s.gss")
    assert stats.sections("delta")["motion"] == sum(p.sizes.get("motion", 0) for p in packets) > 0
    assert all(found.coded >= found.entropy * 0.99 for found in stats.packets)


def test_a_key_packet_forgets_groups_and_displacements():
    """Late join: after a key packet the same bytes mean the same, whatever was before it."""
    rng = np.random.default_rng(5)
    moved = decode_all(make_moving_packets(seed=4, number=30, nodes=9))[-1]
    assert moved.scene.displacement is not None
    assert moved.scene.groups is not None
    key = encode_key(KeyState(moved.gaussians, moved.layout, moved.meta), frame=moved.frame + 1)
    late, along = decode_packet(None, key.data), decode_packet(moved, key.data)
    assert (along.scene.displacement, along.scene.groups) == (None, None)
    delta = Delta((make_motion(rng, late.scene),))
    assert same_bits(follow(late, delta).gaussians, follow(along, delta).gaussians)


def test_an_empty_packet_forgets_displacements_and_keeps_groups():
    rng = np.random.default_rng(6)
    state = begin(rng)
    state = follow(state, Delta((make_motion(rng, state.scene, share=1.0),)))
    still = decode_packet(state, encode_empty(frame=2).data)
    assert still.scene.displacement is None
    assert still.scene.groups is state.scene.groups
    assert still.gaussians is state.gaussians
    on = dataclasses.replace(make_motion(rng, still.scene, share=1.0))
    on = dataclasses.replace(on, symbols=np.zeros_like(on.symbols))
    drift = np.abs(follow(still, Delta((on,))).gaussians.means - still.gaussians.means).max()
    assert drift < 1e-6, "predicted from nothing: it stands still"


PINNED = {
    "rest": "138f2b9357776ceb70343ca9b0e07a87e28b821be86ea93d86fff194f6bcfdfd",
    "predicted": "cac41a1c29231248418d124dbf92b3411a7232242a50d7229fc2360ceca75fb7",
    "residual": "919d7735505ad4fc17adcef5831f1e6c4f9635f7f2fdc34220bb9d827b3f4782",
    "two": "d33dbe211ac30a7b6025c7f14e3b633b537326d349f349ea6802cfcb4a920a84",
    "rows": "3f3f3ee026952c566a7b0a2e621a1b884dccead40fe7b28e1553b73adc91f921",
    "again": "7ac8c509210fa8ebebb5863e4effa507bbbcd9f7f276aef3949a24e114f4fc52",
}


def pinned_stream() -> dict[str, PlayerState]:
    """A scene of integers and halves, changed in every way, without random numbers."""
    number = 24
    grid = np.arange(number * 3, dtype=np.float32).reshape(number, 3)
    scene = dataclasses.replace(
        make_scene(np.random.default_rng(0), number, 0),
        means=grid % 7 - grid % 5 / 2,
        quats=np.stack([np.ones(number), grid[:, 0] % 3, -grid[:, 1] % 4, grid[:, 2] % 2], 1).astype(np.float32),
        scales=-2 - grid % 2,
        opacities=grid[:, 0] % 3,
        sh0=(grid % 4 / 4 - 0.4).astype(np.float32)[:, None],
    )
    layout = Layout(np.full(6, 4, np.int32), np.zeros(number, np.uint8), np.float32([1]))
    state = decode_packet(None, encode_key(KeyState(scene, layout, make_key(np.random.default_rng(0)).meta)).data)
    states = {}

    def add(name, *changes):
        nonlocal state
        state = states[name] = follow(state, Delta(changes))

    def motion(cell, brightness_bins, groups, every, **said):
        moving = (np.arange(groups) % every == 0).astype(np.uint8)
        symbols = np.arange(6 * int(moving.sum()), dtype=np.int32).reshape(-1, 6) % 11 - 5
        return Motion(cell, brightness_bins, moving, symbols, 0.25, 0.125, **said)

    def count(cell, brightness_bins):
        # Cells by the text, of the scene as it is.
        world = World.of(state.gaussians)
        world.form_groups(cell, brightness_bins, False)
        return world.count

    add("rest", motion(2.0, 2, count(2.0, 2), 2, predicted=False))
    add("predicted", motion(2.0, 2, state.scene.groups.count, 3))
    residual = Residual(np.uint8([2, 0, 1, 0, 0, 2]), 2, {"means": np.ones((12, 3), np.int32)}, {"means": 0.5})
    add("residual", motion(2.0, 2, state.scene.groups.count, 1), residual)
    first = motion(4.0, 1, count(4.0, 1), 2)
    world = World.of(state.gaussians)
    last = state.scene.displacement
    world.moved = {
        int(row): (translation.tolist(), rotation.tolist())
        for row, translation, rotation in zip(last.rows, last.translation, last.rotation, strict=True)
    }
    world.move(first)
    world.form_groups(1.0, 1, False)
    add("two", first, motion(1.0, 1, world.count, 2))
    added = add_as_nodes(scene.rows(np.array([0, 5])), np.zeros(2), 6)
    add("rows", motion(1.0, 1, state.scene.groups.count, 2), RowEdit(added, np.array([0, 7, 23])))
    add("again", motion(1.0, 1, state.scene.groups.count, 1))
    return states


def test_pinned_bits_after_every_kind_of_change():
    """Another machine, another numpy or another compiler would notice here."""
    found = {name: digest(state.gaussians) for name, state in pinned_stream().items()}
    assert found == PINNED


def test_motions_alone_change_nothing_but_centres_and_quaternions():
    packets = make_moving_packets(seed=14, number=20, nodes=5)
    for before, after in itertools.pairwise(decode_all(packets)):
        if after.delta is not None and all(isinstance(change, Motion) for change in after.delta.changes):
            for name in ("scales", "opacities", "sh0", "shN"):
                assert getattr(after.gaussians, name) is getattr(before.gaussians, name)


def test_groups_of_a_scene_without_rows_are_forgotten():
    """A scene without Gaussians has 0 groups; what was added into it belonged to one: an IndexError in players."""
    rng = np.random.default_rng(11)
    for number in (0, 5):
        state = begin(rng, number, 2)
        motion = make_motion(rng, state.scene)
        rows = RowEdit(add_as_nodes(make_scene(rng, 3), np.zeros(3), 2), np.arange(number))
        state = follow(state, Delta((motion, rows)))
        assert state.scene.groups is None
        assert len(state.gaussians) == 3
        state = follow(state, Delta((make_motion(rng, state.scene, share=1.0),)))
        assert state.scene.groups.count > 0


def test_known_motions_are_not_encoded_again_and_give_the_same_packet() -> None:
    rng = np.random.default_rng(3)
    state = begin(rng)
    moved = make_motions(rng, state.scene, 2)
    delta = Delta((*moved.changes, *make_delta(rng, state.layout).changes))
    known = delta.motions, encode_motions(delta.motions)
    for some in (delta, delta.with_residual(None)):
        wanted = encode_delta(some, state.layout, state.decoders, frame=1)
        assert encode_delta(some, state.layout, state.decoders, frame=1, known=known).data == wanted.data


def test_sections_of_other_motions_are_not_taken() -> None:
    rng = np.random.default_rng(4)
    state = begin(rng)
    delta = make_motions(rng, state.scene, 1)
    other = Delta((replace(delta.motions[0], symbols=delta.motions[0].symbols + 1),))
    known = other.motions, encode_motions(other.motions)
    packet = encode_delta(delta, state.layout, state.decoders, frame=1, known=known)
    found = decode_delta(packet.data, state.scene, state.decoders)
    np.testing.assert_array_equal(found.motions[0].symbols, delta.motions[0].symbols)
    residual = make_delta(rng, state.layout)
    wanted = encode_delta(residual, state.layout, state.decoders, frame=1).data
    assert encode_delta(residual, state.layout, state.decoders, frame=1, known=known).data == wanted


@settings(max_examples=30, deadline=None)
@given(SEEDS, st.lists(st.integers(0, MOST_SKIPPED + 1), min_size=1, max_size=4))
@example(0, [0, 1, 0])
@example(0, [MOST_SKIPPED, MOST_SKIPPED + 1])
def test_what_moves_steadily_is_heading_where_it_goes_whatever_was_skipped(seed: int, skipped: list[int]) -> None:
    """Between two frames that are sent lie some that are skipped: an independent count of the way."""
    rng = np.random.default_rng(seed)
    state = decode_packet(None, encode_key(make_key(rng, 6, 2)).data)
    assert (state.scene.heading, state.empty) == (None, 0)
    way = 2.0**-4 * rng.integers(1, 9, 3)  # a frame's; sums of it are exact
    for empty in skipped:
        has_moved = state.scene.displacement is not None
        for number in range(1, empty + 1):
            state = decode_packet(state, encode_empty(frame=state.frame + 1).data)
            assert state.empty == number
            assert state.scene.displacement is None
            if not has_moved or number > MOST_SKIPPED:
                assert state.scene.heading is None
            else:
                gone = state.scene.heading.translation
                np.testing.assert_allclose(gone, np.tile((number + 1) * way, (6, 1)), atol=1e-5)
        predicted = 0 if state.scene.displacement is None else state.scene.displacement.translation[0]
        delta = Delta((every_group(state.scene, (empty + 1) * way - predicted),))
        state = decode_packet(state, encode_delta(delta, state.layout, state.decoders, frame=state.frame + 1).data)
        ahead = state.scene.heading if empty else state.scene.displacement
        np.testing.assert_allclose(ahead.translation, np.tile(way, (6, 1)), atol=1e-5)
        assert (state.empty, state.scene.heading is None) == (0, empty == 0)


def test_an_empty_packet_after_a_hostile_motion_is_decoded_without_a_warning() -> None:
    state = decode_packet(None, encode_key(make_key(np.random.default_rng(0), 6, 2)).data)
    far = np.full((6, 3), 2e38, np.float32)
    state = replace(state, scene=replace(state.scene, displacement=Displacement(np.arange(6), far, far)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        after = decode_packet(state, encode_empty(frame=1).data)
    assert np.isinf(after.scene.heading.translation).all()


def every_group(scene: Scene, correction: np.ndarray) -> Motion:
    """All rows move; their prediction is corrected by a shift in sixteenths."""
    groups = groups_for(scene, 1e6, 1).count
    symbols = np.concatenate([np.rint(correction * 16), np.zeros(3)]).astype(np.int32)
    return Motion(1e6, 1, np.ones(groups, np.uint8), np.tile(symbols, (groups, 1)), 2.0**-4, 2.0**-4)
