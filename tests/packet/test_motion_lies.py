"""Motions that lie: flags, cells, groups and symbols that cannot be end in one PacketError with its byte."""

from __future__ import annotations

import dataclasses
import itertools
import struct

import numpy as np
import pytest
from packet_scenes import begin, follow, make_births, make_delta, make_motion, replaced

from gsstream.core.changes import Delta, Groups, Motion, Rows, Scene, apply_delta
from gsstream.core.errors import PacketError, ShapeError
from gsstream.packet import PlayerState, decode_packet, encode_delta
from gsstream.packet.base import build_packet, parse_packet
from gsstream.packet.bits import pack_blobs, unpack_blobs
from gsstream.packet.gates import encode_gates
from gsstream.packet.symbols import encode_symbols

HEAD = struct.Struct("<BBfff")


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
    none = encode_gates(np.zeros(count, np.uint8), 1)
    yield "nothing moves, but symbols", head + pack_blobs([none, symbols]), "empty table"
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


@pytest.mark.filterwarnings("error")
@pytest.mark.usefixtures("bounded_memory")
@pytest.mark.parametrize("lie", LIES)
def test_lies_about_a_motion_are_refused_at_its_section(lie):
    state, _ = moving_state()
    before = [array.tobytes() for _, array in state.gaussians.items()]
    part, message = LIES[lie]
    data = with_motion(part)
    with pytest.raises(PacketError, match=message) as caught:
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


@pytest.mark.filterwarnings("error")
def test_positions_beyond_float32_are_refused_and_leave_the_state_alone():
    """Predicted eight times in each frame, a shift grows eightfold per frame: it ends in words, not in infinity."""
    state = begin(np.random.default_rng(9), 10, 3)
    state = follow(state, Delta((far(state),)))
    with pytest.raises(PacketError, match="beyond the range of float32") as caught:  # noqa: PT012 - some frame fails
        for _ in range(60):
            motion = make_motion(np.random.default_rng(0), state.scene, share=1.0)
            on = dataclasses.replace(motion, symbols=np.zeros_like(motion.symbols))
            packet = encode_delta(Delta((on,) * 8), state.layout, {}, frame=state.frame + 1)
            before = state.gaussians.means.tobytes()
            state = decode_packet(state, packet.data, offset=500)
            state.gaussians.validate()
    assert 500 <= caught.value.offset < 500 + len(packet.data)
    assert state.gaussians.means.tobytes() == before


@pytest.mark.filterwarnings("error")
def test_a_jump_through_the_whole_range_is_kept_without_a_warning():
    """Both ends are finite, their difference is not: a motion predicted from that is refused."""
    state = begin(np.random.default_rng(10), 4, 2)
    means = np.where(np.arange(4)[:, None] % 2, 3e38, -3e38).astype(np.float32) * np.ones((1, 3), np.float32)
    step, half = float(np.float32(9e8)), np.int32([[0, 0, 0, 0, 0, 1 << 30]])
    motion = Motion(step, 1, np.ones(1, np.uint8), half, 1.0, step, predicted=False)
    groups = Groups(motion.cell, motion.shades, np.zeros(4, np.int32), 1)
    scene = Scene(dataclasses.replace(state.gaussians, means=means), state.layout, groups=groups)
    after = apply_delta(scene, Delta((motion,)))
    assert np.isfinite(after.gaussians.means).all()
    assert np.isinf(after.moved.shift).any()
    on = dataclasses.replace(motion, predicted=True, symbols=np.zeros((1, 6), np.int32))
    with pytest.raises(ShapeError, match="beyond the range of float32"):
        apply_delta(after, Delta((on,)))


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
    header, sections = parse_packet(packet.data)
    names = list(sections)
    assert names == ["motion", "gates", "pattern", "means", "quats", "opacities", "sh0", "deaths", "births"]
    for first, second in itertools.pairwise(range(len(names))):
        order = list(names)
        order[first], order[second] = order[second], order[first]
        data = build_packet(header.kind, header.frame, [(name, sections[name].data) for name in order]).data
        with pytest.raises(PacketError, match="do not stand in this order") as caught:
            decode_packet(state, data, offset=3)
        assert caught.value.offset == 3
