"""The limits of fields: the largest shapes and weights, what takes too long, and what an encoder refuses."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from packet_scenes import begin, make_field

from gsstream.core.changes import Delta, Field, apply_field
from gsstream.core.errors import PacketError, ShapeError
from gsstream.packet import PlayerState, decode_packet, encode_delta


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
        (change(field, entry_step=0), "step of entry"), (change(field, weight_step=2**17 + 1), "step of weight"),
        (change(field, shape=change(field.shape, reach=0.1)), "reach: expected a float32"),
        (change(field, shape=change(field.shape, low=(0.1, 0.0, 0.0))), "box: expected float32"),
        (change(field, entries=field.entries[1:]), "expected tables of 3 levels and 3 layers, got 5"),
        (change(field, weights=tuple(w.astype(np.int64) for w in field.weights)), "expected tables of int32"),
        (change(field, marks=2 * field.marks), "gates: expected"),
    ]  # fmt: skip
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
