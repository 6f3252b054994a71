"""The ends of what motions, fields and scenes can say: what is reached, what is refused, and what is not written."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from packet_scenes import (
    begin,
    follow,
    make_births,
    make_delta,
    make_field,
    make_key,
    make_motion,
    moving_state,
)

from gsstream.core.changes import Delta, Field, Groups, Layout, Motion, RowEdit, Scene, apply_delta, apply_field
from gsstream.core.errors import PacketError, ShapeError
from gsstream.packet import PlayerState, decode_packet, encode_delta, encode_key
from gsstream.packet.base import build_packet, parse_packet


def far(state: PlayerState, *, predicted: bool = False) -> Motion:
    motion = make_motion(np.random.default_rng(0), state.scene, share=1.0, predicted=predicted)
    symbols = np.zeros_like(motion.symbols)
    symbols[:, :3] = 2**30
    return dataclasses.replace(motion, symbols=symbols, translation_step=float(np.float32(9e8)))


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
    groups = Groups(motion.cell, motion.brightness_bins, np.zeros(4, np.int32), 1)
    scene = Scene(dataclasses.replace(state.gaussians, means=means), state.layout, groups=groups)
    after = apply_delta(scene, Delta((motion,)))
    assert np.isfinite(after.gaussians.means).all()
    assert np.isinf(after.displacement.translation).any()
    on = dataclasses.replace(motion, predicted=True, symbols=np.zeros((1, 6), np.int32))
    with pytest.raises(ShapeError, match="beyond the range of float32"):
        apply_delta(after, Delta((on,)))


def test_an_encoder_refuses_motions_that_are_none():
    state, delta = moving_state()
    motion, change = delta.motions[0], dataclasses.replace
    wrong = [
        (change(motion, cell=0.1), "cell: expected a float32"), (change(motion, rotation_step=0.1), "rotation_step"),
        (change(motion, translation_step=0.0), "translation_step"),
        (change(motion, brightness_bins=17), "brightness_bins"),
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
    motion = dataclasses.replace(motion, symbols=symbols, rotation_step=float(np.float32(9e8)))
    follow(state, Delta((motion,)))


@pytest.mark.parametrize("delta", [Delta(), Delta((RowEdit(),))])
def test_a_delta_without_changes_is_not_written(delta):
    """No reader would take it: a delta packet has at least one section."""
    state = begin(np.random.default_rng(12))
    with pytest.raises(ShapeError, match="at least one change"):
        encode_delta(delta, state.layout, {}, frame=1)


def test_sections_in_another_order_are_refused():
    rng = np.random.default_rng(13)
    state = begin(rng)
    delta = Delta((make_motion(rng, state.scene), *make_delta(rng, state.layout, latent=False).changes))
    delta = delta.with_row_edit(RowEdit(make_births(rng, state.layout, 3, 1), np.array([4])))
    packet = encode_delta(delta, state.layout, {}, frame=1)
    header, sections = parse_packet(packet.data)
    names = list(sections)
    assert names == ["motion", "gates", "pattern", "means", "quats", "opacities", "sh0", "removed", "added"]
    for first, second in itertools.pairwise(range(len(names))):
        order = list(names)
        order[first], order[second] = order[second], order[first]
        data = build_packet(header.kind, header.frame, [(name, sections[name].data) for name in order]).data
        with pytest.raises(PacketError, match="do not stand in this order") as caught:
            decode_packet(state, data, offset=3)
        assert caught.value.offset == 3


def field_state(size: int = 9) -> tuple[PlayerState, Field]:
    rng = np.random.default_rng(8)
    state = begin(rng, 30, 9)
    return state, make_field(rng, state.scene, 0.7, size)


@pytest.mark.filterwarnings("error")
@pytest.mark.usefixtures("bounded_memory")
def test_the_largest_shape_costs_little_where_few_rows_move():
    """Every count at its limit, in a packet of some hundred bytes: memory follows the rows."""
    rng = np.random.default_rng(9)
    state = begin(rng, 30, 9)
    said = {"levels": 16, "entries": 16, "features": 8, "base": 1024, "growth": 1.5, "width": 128, "layers": 4}
    field = make_field(rng, state.scene, None, size=0, **said)
    packet = encode_delta(Delta((field,)), state.layout, {}, frame=1)
    assert len(packet.data) < 500
    assert decode_packet(state, packet.data).gaussians.means.tobytes() == state.gaussians.means.tobytes()


@pytest.mark.usefixtures("bounded_memory")
def test_a_field_that_would_take_too_long_is_refused_before_it_is_looked_up(monkeypatch):
    state, field = field_state()
    packet = encode_delta(Delta((field,)), state.layout, {}, frame=1)
    rows = len(apply_field(state.scene, field)[1])
    assert rows > 1
    assert field.shape.flops == 8 * 6 + 6 * 5 + 5 * 5 + 5 * 7
    monkeypatch.setattr("gsstream.core.changes.field.MAX_FLOPS", rows * field.shape.flops)
    decode_packet(state, packet.data)
    monkeypatch.setattr("gsstream.core.changes.field.MAX_FLOPS", rows * field.shape.flops - 1)
    monkeypatch.setattr("gsstream.core.changes.hashgrid.FieldShape.corners", None)
    with pytest.raises(PacketError, match="expected a smaller network or fewer Gaussians") as caught:
        decode_packet(state, packet.data, offset=5)
    assert caught.value.offset == 5 + 16 + 5


@pytest.mark.filterwarnings("error")
def test_the_largest_weights_and_positions_stay_finite():
    """What follows from the limits of weights and reach: no field leads out of the range of float32."""
    state, field = field_state()
    corner = np.finfo(np.float32).max
    means = np.full_like(state.gaussians.means, corner)
    scene = dataclasses.replace(state.scene, gaussians=dataclasses.replace(state.gaussians, means=means))
    side = float(np.nextafter(corner, np.float32(0)))
    shape = dataclasses.replace(field.shape, low=(side,) * 3, high=(float(corner),) * 3, reach=float(np.float32(9e8)))
    entries = [np.full((len(which), 2), (1 << 25) - 1) for which in shape.touched(shape.unit(means))]
    weights = [np.full_like(start, (1 << 17) - 1) for start in shape.start_weights()]
    large = Field(shape, None, *(tuple(table.astype(np.int32) for table in some) for some in (entries, weights)), 1, 1)
    after, rows = apply_field(scene, large)
    assert len(rows) == len(means)
    after.gaussians.validate()


def test_an_encoder_refuses_fields_that_are_none():
    state, field = field_state()
    change = dataclasses.replace
    wrong = [
        (change(field, entry_step=0), "step of entry"),
        (change(field, weight_step=2**17 + 1), "step of weight"),
        (change(field, shape=change(field.shape, reach=0.1)), "reach: expected a float32"),
        (change(field, shape=change(field.shape, low=(0.1, 0.0, 0.0))), "box: expected float32"),
        (change(field, entries=field.entries[1:]), "expected tables of 3 levels and 3 layers, got 5"),
        (change(field, weights=tuple(w.astype(np.int64) for w in field.weights)), "expected tables of int32"),
        (change(field, marks=2 * field.marks), "gates: expected"),
    ]
    for bad, message in wrong:
        with pytest.raises(ShapeError, match=message):
            encode_delta(Delta((bad,)), state.layout, {}, frame=1)
    fits = [
        (change(field, marks=field.marks[1:]), "a mark for each of 30 Gaussians"),
        (change(field, entries=tuple(e[:-1] for e in field.entries)), "symbols of entries of level 0"),
        (change(field, weights=tuple(w.T for w in field.weights)), "symbols of layer 0"),
        (change(field, weight_step=1 << 17), "units in size"),
    ]
    for bad, message in fits:
        with pytest.raises(ShapeError, match=message):
            apply_field(state.scene, bad)


def test_more_equal_gaussians_than_readers_accept_are_not_written():
    number = 400_000
    state = make_key(np.random.default_rng(9), 1, 1)
    rows = np.zeros(number, np.int64)
    layout = Layout(np.int32([number]), np.zeros(number, np.uint8), state.layout.units)
    with pytest.raises(ShapeError, match="Gaussians that differ"):
        encode_key(dataclasses.replace(state, gaussians=state.gaussians.rows(rows), layout=layout))
