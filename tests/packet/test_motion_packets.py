"""Motions in packets: round trips, a second decoder written from the text, pinned bits, and bytes that lie."""

from __future__ import annotations

import dataclasses
import itertools
import struct
import warnings

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from make_samples import digest
from motion_oracle import World
from packet_scenes import (
    decode_all,
    make_births,
    make_delta,
    make_edit,
    make_key,
    make_motion,
    make_motions,
    make_moving_packets,
    make_scene,
    replaced,
    same_bits,
    write_stream,
)

from gsstream.core.changes import (
    Delta,
    Layout,
    Motion,
    Residual,
    Rows,
    apply_delta,
    apply_motion,
    apply_residual,
    gather_rows,
    own_nodes,
    sent_rows,
)
from gsstream.core.errors import PacketError, ShapeError
from gsstream.packet import (
    KeyState,
    PlayerState,
    decode_delta,
    decode_packet,
    encode_delta,
    encode_empty,
    encode_key,
)
from gsstream.packet.base import parse_packet
from gsstream.packet.bits import pack_blobs, unpack_blobs
from gsstream.packet.gates import encode_gates
from gsstream.packet.symbols import encode_symbols
from gsstream.player.playback import Playback
from gsstream.trade.measure.stream_stats import stream_stats

SEEDS = st.integers(0, 2**32 - 1)
HEAD = struct.Struct("<BBfff")


def begin(rng: np.random.Generator, number: int = 40, nodes: int = 12, reach: float = 1.0) -> PlayerState:
    """The state after a key packet; ``reach`` scales where the Gaussians are."""
    key = make_key(rng, number, nodes)
    means = (key.gaussians.means * np.float32(reach)).astype(np.float32)
    key = dataclasses.replace(key, gaussians=dataclasses.replace(key.gaussians, means=means))
    return decode_packet(None, encode_key(key).data)


def follow(state: PlayerState, delta: Delta) -> PlayerState:
    return decode_packet(state, encode_delta(delta, state.layout, state.decoders, frame=state.frame + 1).data)


def random_frame(rng: np.random.Generator, state: PlayerState, reach: float) -> Delta | None:
    """Up to three motions of any kind, then perhaps a residual, births and deaths; None: an empty packet."""
    if rng.random() < 0.15:
        return None
    scene, motions = state.scene, []
    for _ in range(int(rng.integers(0, 4))):
        cell = float(np.float32(reach * rng.choice([0.01, 0.7, 2.0, 1e4])))
        motion = make_motion(
            rng, scene, cell, int(rng.choice([1, 2, 16])), float(rng.choice([0.0, 0.5, 1.0])),
            predicted=bool(rng.random() < 0.7), regroup=bool(rng.random() < 0.3),
        )  # fmt: skip
        if motions and rng.random() < 0.5:  # the groups of the one before, once more
            last = motions[-1]
            moving = last.moving * (rng.random(len(last.moving)) < 0.5).astype(np.uint8)
            symbols = rng.integers(-9, 10, (int(moving.sum()), 6)).astype(np.int32)
            motion = dataclasses.replace(last, moving=moving, symbols=symbols, regroup=False)
        motion = dataclasses.replace(motion, turn_step=float(np.float32(rng.choice([0.01, 0.3, 40.0]))))
        scene, _ = apply_motion(scene, motion)
        motions.append(motion)
    rest: tuple[Residual | Rows, ...] = ()
    if rng.random() < 0.5:
        rest = make_delta(rng, state.layout).changes
    if rng.random() < 0.4:
        rest = make_edit(rng, state, int(rng.integers(0, 5)), float(rng.choice([0.1, 1.0], p=[0.8, 0.2]))).changes
    delta = Delta((*motions, *rest))
    return delta if motions or not delta.is_empty else None


def oracle_step(world: World, state: PlayerState, after: PlayerState) -> None:
    """Step the oracle with what the packet said. Residual and births are not its subject: their values are taken."""
    if after.delta is None:
        world.moved = {}
        return
    means, quats = [list(row) for row in world.means], [list(row) for row in world.quats]
    touched: set[int] = set()
    for motion in after.delta.motions:
        touched |= world.move(motion)
    if after.delta.residual is not None:
        gaussians = dataclasses.replace(
            state.gaussians, means=np.array(world.means, np.float32).reshape(-1, 3),
            quats=np.array(world.quats, np.float32).reshape(-1, 4),
        )  # fmt: skip
        changed = apply_residual(gaussians, state.layout, after.delta.residual)
        world.means, world.quats = changed.means.tolist(), changed.quats.tolist()
        world.sh0 = changed.sh0[:, 0].tolist()
        touched |= set(sent_rows(state.layout, after.delta.residual.gates).tolist())
    world.displaced(means, quats, touched)
    if after.delta.edits_rows:
        source = gather_rows(state.layout.node_of, after.delta.births, after.delta.deaths).tolist()
        tables = [world.means, world.quats, world.sh0]
        if after.delta.births is not None:
            born = World.of(after.delta.births.gaussians)
            tables = [world.means + born.means, world.quats + born.quats, world.sh0 + born.sh0]
        world.edit(source, *([table[row] for row in source] for table in tables))


def check_equal(world: World, state: PlayerState) -> None:
    """Bit for bit: centres, quaternions, groups, displacements."""
    number = len(state.gaussians)
    assert np.array(world.means, np.float32).reshape(number, 3).tobytes() == state.gaussians.means.tobytes()
    assert np.array(world.quats, np.float32).reshape(number, 4).tobytes() == state.gaussians.quats.tobytes()
    groups, moved = state.scene.groups, state.scene.moved
    if world.named is None:
        assert groups is None
    else:
        assert (groups.cell, groups.shades) == world.named
        assert (groups.group_of.tolist(), groups.count) == (world.group_of, world.count)
    found = {} if moved is None else {
        row: (shift, turn)
        for row, shift, turn in zip(moved.rows.tolist(), moved.shift.tolist(), moved.turn.tolist(), strict=True)
    }  # fmt: skip
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
        for name in ("cell", "shades", "shift_step", "turn_step", "predicted", "regroup"):
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
    assert moved.scene.moved is not None
    assert moved.scene.groups is not None
    key = encode_key(KeyState(moved.gaussians, moved.layout, moved.meta), frame=moved.frame + 1)
    late, along = decode_packet(None, key.data), decode_packet(moved, key.data)
    assert (along.scene.moved, along.scene.groups) == (None, None)
    delta = Delta((make_motion(rng, late.scene),))
    assert same_bits(follow(late, delta).gaussians, follow(along, delta).gaussians)


def test_an_empty_packet_forgets_displacements_and_keeps_groups():
    rng = np.random.default_rng(6)
    state = begin(rng)
    state = follow(state, Delta((make_motion(rng, state.scene, share=1.0),)))
    still = decode_packet(state, encode_empty(frame=2).data)
    assert still.scene.moved is None
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
        make_scene(np.random.default_rng(0), number, 0), means=grid % 7 - grid % 5 / 2,
        quats=np.stack([np.ones(number), grid[:, 0] % 3, -grid[:, 1] % 4, grid[:, 2] % 2], 1).astype(np.float32),
        scales=-2 - grid % 2, opacities=grid[:, 0] % 3, sh0=(grid % 4 / 4 - 0.4).astype(np.float32)[:, None],
    )  # fmt: skip
    layout = Layout(np.full(6, 4, np.int32), np.zeros(number, np.uint8), np.float32([1]))
    state = decode_packet(None, encode_key(KeyState(scene, layout, make_key(np.random.default_rng(0)).meta)).data)
    states = {}

    def add(name, *changes):
        nonlocal state
        state = states[name] = follow(state, Delta(changes))

    def motion(cell, shades, groups, every, **said):
        moving = (np.arange(groups) % every == 0).astype(np.uint8)
        symbols = np.arange(6 * int(moving.sum()), dtype=np.int32).reshape(-1, 6) % 11 - 5
        return Motion(cell, shades, moving, symbols, 0.25, 0.125, **said)

    def count(cell, shades):
        # Cells by the text, of the scene as it is.
        world = World.of(state.gaussians)
        world.form_groups(cell, shades, False)
        return world.count

    add("rest", motion(2.0, 2, count(2.0, 2), 2, predicted=False))
    add("predicted", motion(2.0, 2, state.scene.groups.count, 3))
    residual = Residual(np.uint8([2, 0, 1, 0, 0, 2]), 2, {"means": np.ones((12, 3), np.int32)}, {"means": 0.5})
    add("residual", motion(2.0, 2, state.scene.groups.count, 1), residual)
    first = motion(4.0, 1, count(4.0, 1), 2)
    world = World.of(state.gaussians)
    world.moved = {
        int(r): (s.tolist(), t.tolist())
        for r, s, t in zip(state.scene.moved.rows, state.scene.moved.shift, state.scene.moved.turn, strict=True)
    }
    world.move(first)
    world.form_groups(1.0, 1, False)
    add("two", first, motion(1.0, 1, world.count, 2))
    born = own_nodes(scene.rows(np.array([0, 5])), np.zeros(2), 6)
    add("rows", motion(1.0, 1, state.scene.groups.count, 2), Rows(born, np.array([0, 7, 23])))
    add("again", motion(1.0, 1, state.scene.groups.count, 1))
    return states


def test_pinned_bits_after_every_kind_of_change():
    """Another machine, another numpy or another compiler would notice here."""
    found = {name: digest(state.gaussians) for name, state in pinned_stream().items()}
    assert found == PINNED


def moving_state() -> tuple[PlayerState, Delta]:
    rng = np.random.default_rng(8)
    state = begin(rng, 30, 9)
    state = follow(state, Delta((make_motion(rng, state.scene, predicted=False),)))
    return state, Delta((make_motion(rng, state.scene, share=0.7),))


def with_motion(part: bytes) -> bytes:
    """A packet whose one motion is these bytes."""
    state, delta = moving_state()
    return replaced(encode_delta(delta, state.layout, {}, frame=2), "motion", b"\1" + part)


def parts_of(delta: Delta, state: PlayerState) -> tuple[bytes, list[bytes]]:
    data = parse_packet(encode_delta(delta, state.layout, {}, frame=2).data)[1]["motion"].data
    return data[1 : 1 + HEAD.size], unpack_blobs(data[1 + HEAD.size :], 2)


def lies():
    state, delta = moving_state()
    head, (gates, symbols) = parts_of(delta, state)
    flags, shades, cell, shift, turn = HEAD.unpack(head)
    tail, count = pack_blobs([gates, symbols]), state.scene.groups.count
    moving = int(delta.motions[0].moving.sum())

    def headed(*fields):
        return HEAD.pack(*fields) + tail

    nan, inf = float("nan"), float("inf")
    for bits in (4, 8, 128, 255):
        yield f"flags {bits}", headed(bits, shades, cell, shift, turn), "unknown flags"
    for wrong in (0, 17, 255):
        yield f"{wrong} shades", headed(flags, wrong, cell, shift, turn), "shades: expected 1 to 16"
    for wrong in (0.0, -0.0, -1.0, nan, inf, -inf, 1e9):
        yield f"cell {wrong}", headed(flags, shades, wrong, shift, turn), "cell: expected a float32 above 0"
        yield f"shift step {wrong}", headed(flags, shades, cell, wrong, turn), "shift_step: expected a float32"
        yield f"turn step {wrong}", headed(flags, shades, cell, shift, wrong), "turn_step: expected a float32"
    yield "other cells", headed(flags, shades, cell * 100, shift, turn), "."
    every = (np.arange(count + 1) % 2).astype(np.uint8)
    yield "one group more", head + pack_blobs([encode_gates(every, 1), symbols]), "gates: 1 levels in"
    few = encode_gates((np.arange(count + 50) == count + 40).astype(np.uint8), 1)
    yield "runs beyond the groups", head + pack_blobs([few, b""]), "gate"
    yield "levels", head + pack_blobs([encode_gates(np.full(count, 2, np.uint8), 2), symbols]), "no levels"
    yield "no symbols", head + pack_blobs([gates, b""]), "."
    yield "symbols of one group more", head + pack_blobs(
        [gates, encode_symbols(np.arange(6 * moving + 6, dtype=np.int32).reshape(-1, 6))]
    ), "."
    yield "nothing moves, but symbols", head + pack_blobs([encode_gates(np.zeros(count, np.uint8), 1), symbols]), "empty"
    large = encode_symbols(np.full((moving, 6), 2**31 - 1, np.int32))
    over = HEAD.pack(flags, shades, cell, 9e8, turn)
    yield "a shift that overflows", over + pack_blobs([gates, large]), "cannot be"
    over = HEAD.pack(flags, shades, cell, shift, 9e8)
    yield "a turn that overflows", over + pack_blobs([gates, large]), "cannot be"
    for cut in range(HEAD.size):
        yield f"cut after {cut} bytes", head[:cut], "motion cut short"
    yield "cut after the head", head, "."
    yield "a byte more", head + tail + b"\0", "."


LIES = {name: (part, message) for name, part, message in lies()}


@pytest.mark.usefixtures("bounded_memory")
@pytest.mark.parametrize("lie", LIES)
def test_lies_about_a_motion_are_refused_at_its_section(lie):
    state, _ = moving_state()
    before = [array.tobytes() for _, array in state.gaussians.items()]
    part, message = LIES[lie]
    data = with_motion(part)
    with warnings.catch_warnings(), pytest.raises(PacketError, match=message) as caught:
        warnings.simplefilter("error")
        decode_packet(state, data, offset=1000)
    assert caught.value.offset == 1000 + 16 + 5
    assert str(caught.value).count("(at byte") == 1
    assert [array.tobytes() for _, array in state.gaussians.items()] == before


@pytest.mark.parametrize("number", [0, 2, 9, 255])
def test_lies_about_the_number_of_motions(number):
    state, delta = moving_state()
    packet = encode_delta(delta, state.layout, {}, frame=2)
    data = parse_packet(packet.data)[1]["motion"].data
    for liar in (bytes([number]) + data[1:], bytes([number])):
        with pytest.raises(PacketError) as caught:
            decode_packet(state, replaced(packet, "motion", liar), offset=7)
        assert caught.value.offset == 7 + 16 + 5
    with pytest.raises(PacketError, match="expected 1 to 8 motions, got 0"):
        decode_packet(state, replaced(packet, "motion", b""))


def far(state: PlayerState, *, predicted: bool = False) -> Motion:
    motion = make_motion(np.random.default_rng(0), state.scene, share=1.0, predicted=predicted)
    symbols = np.zeros_like(motion.symbols)
    symbols[:, :3] = 2**30
    return dataclasses.replace(motion, symbols=symbols, shift_step=float(np.float32(9e8)))


def test_positions_beyond_float32_are_refused_and_leave_the_state_alone():
    """Predicted eight times in each frame, a shift grows eightfold per frame; the stream ends in words, not in infinity."""
    state = begin(np.random.default_rng(9), 10, 3)
    state = follow(state, Delta((far(state),)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(60):
            motion = make_motion(np.random.default_rng(0), state.scene, share=1.0)
            delta = Delta((dataclasses.replace(motion, symbols=np.zeros_like(motion.symbols)),) * 8)
            packet = encode_delta(delta, state.layout, {}, frame=state.frame + 1)
            before = state.gaussians.means.tobytes()
            try:
                state = decode_packet(state, packet.data, offset=500)
            except PacketError as error:
                assert "beyond the range of float32" in str(error)
                assert 500 <= error.offset < 500 + len(packet.data)
                assert state.gaussians.means.tobytes() == before
                return
            state.gaussians.validate()
    pytest.fail("it never left the range")


def test_a_jump_through_the_whole_range_is_kept_without_a_warning():
    """Both ends are finite, their difference is not: a motion predicted from that is refused."""
    state = begin(np.random.default_rng(10), 4, 2)
    means = np.where(np.arange(4)[:, None] % 2, 3e38, -3e38).astype(np.float32) * np.ones((1, 3), np.float32)
    state = dataclasses.replace(
        state, scene=dataclasses.replace(state.scene, gaussians=dataclasses.replace(state.gaussians, means=means))
    )
    half = Motion(float(np.float32(9e8)), 1, np.ones(2, np.uint8), np.zeros((2, 6), np.int32), 1.0, 9e8, predicted=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        one = dataclasses.replace(half, moving=np.ones(1, np.uint8), symbols=np.int32([[0, 0, 0, 0, 0, 1 << 30]]))
        everything = dataclasses.replace(state.scene.gaussians, means=means)
        scene = dataclasses.replace(state.scene, gaussians=everything)
        scene = dataclasses.replace(scene, groups=_one_group(4, one))
        after = apply_delta(scene, Delta((one,)))
        assert np.isfinite(after.gaussians.means).all()
        assert np.isinf(after.moved.shift).any()
        with pytest.raises(ShapeError, match="beyond the range of float32"):
            apply_delta(after, Delta((dataclasses.replace(one, predicted=True, symbols=np.zeros((1, 6), np.int32)),)))


def _one_group(number: int, motion: Motion):
    from gsstream.core.changes import Groups

    return Groups(motion.cell, motion.shades, np.zeros(number, np.int32), 1)


def test_groups_of_a_scene_without_rows_are_forgotten():
    """A scene without Gaussians has 0 groups; those born into it belonged to one all the same: an IndexError in players."""
    rng = np.random.default_rng(11)
    for number in (0, 5):
        state = begin(rng, number, 2)
        motion = make_motion(rng, state.scene)
        rows = Rows(own_nodes(make_scene(rng, 3), np.zeros(3), 2), np.arange(number))
        state = follow(state, Delta((motion, rows)))
        assert state.scene.groups is None
        assert len(state.gaussians) == 3
        state = follow(state, Delta((make_motion(rng, state.scene, share=1.0),)))
        assert state.scene.groups.count > 0


def test_an_encoder_refuses_motions_that_are_none():
    state, delta = moving_state()
    motion, change = delta.motions[0], dataclasses.replace
    wrong = [
        (change(motion, cell=0.1), "cell: expected a float32"), (change(motion, turn_step=0.1), "turn_step"),
        (change(motion, shift_step=0.0), "shift_step"), (change(motion, shades=17), "shades"),
        (change(motion, symbols=motion.symbols.astype(np.int64)), "int32"),
        (change(motion, symbols=motion.symbols[1:]), "symbols: expected"),
        (change(motion, symbols=motion.symbols[:, :5]), "symbols: expected"),
        (change(motion, moving=motion.moving[:, None]), "symbols: expected"),
        (change(motion, moving=2 * motion.moving), "gates: expected"),
        (change(far(state), symbols=np.full_like(far(state).symbols, 2**31 - 1)), "cannot be"),
    ]  # fmt: skip
    for bad, message in wrong:
        with pytest.raises(ShapeError, match=message):
            encode_delta(Delta((bad,)), state.layout, {}, frame=2)
    with pytest.raises(ShapeError, match="at most 8 motions in one frame, got 9"):
        encode_delta(Delta((motion,) * 9), state.layout, {}, frame=2)


def test_the_limit_of_a_correction_is_that_of_its_own_step():
    """A large shift beside a large step of the turn was refused, though no product was too large."""
    state, _ = moving_state()
    motion = make_motion(np.random.default_rng(0), state.scene, share=1.0)
    symbols = np.zeros_like(motion.symbols)
    symbols[:, 0], symbols[:, 3] = 2**31 - 1, 1
    motion = dataclasses.replace(motion, symbols=symbols, turn_step=float(np.float32(9e8)))
    follow(state, Delta((motion,)))


@pytest.mark.parametrize("delta", [Delta(), Delta((Rows(),))])
def test_a_delta_without_changes_is_not_written(delta):
    """No reader would take it: a delta packet has at least one section."""
    state = begin(np.random.default_rng(12))
    with pytest.raises(ShapeError, match="at least one change"):
        encode_delta(delta, state.layout, {}, frame=1)


def test_sections_in_another_order_are_refused():
    rng = np.random.default_rng(13)
    state = begin(rng)
    delta = Delta((make_motion(rng, state.scene), *make_delta(rng, state.layout, latent=False).changes))
    delta = delta.with_rows(Rows(make_births(rng, state.layout, 3, 1), np.array([4])))
    packet = encode_delta(delta, state.layout, {}, frame=1)
    from gsstream.packet.base import build_packet

    header, sections = parse_packet(packet.data)
    names = list(sections)
    assert names == ["motion", "gates", "means", "quats", "opacities", "sh0", "deaths", "births"]
    for first, second in itertools.pairwise(range(len(names))):
        order = list(names)
        order[first], order[second] = order[second], order[first]
        data = build_packet(header.kind, header.frame, [(name, sections[name].data) for name in order]).data
        with pytest.raises(PacketError, match="do not stand in this order") as caught:
            decode_packet(state, data, offset=3)
        assert caught.value.offset == 3


def test_motions_alone_change_nothing_but_centres_and_quaternions():
    packets = make_moving_packets(seed=14, number=20, nodes=5)
    for before, after in itertools.pairwise(decode_all(packets)):
        if after.delta is not None and all(isinstance(change, Motion) for change in after.delta.changes):
            for name in ("scales", "opacities", "sh0", "shN"):
                assert getattr(after.gaussians, name) is getattr(before.gaussians, name)
