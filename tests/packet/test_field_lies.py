"""Fields that lie: shapes, boxes, marks and symbols that cannot be end in one PacketError with its byte."""

from __future__ import annotations

import dataclasses
import struct

import numpy as np
import pytest
from packet_scenes import begin, make_field, replaced

from gsstream.core.changes import Delta, Field, apply_field
from gsstream.core.errors import PacketError, ShapeError
from gsstream.packet import PlayerState, decode_packet, encode_delta
from gsstream.packet.bits import pack_blobs, unpack_blobs
from gsstream.packet.gates import encode_gates
from gsstream.packet.symbols import encode_symbols

HEAD = struct.Struct("<BBBBBBHIII8f")
NAMES = (
    "flags", "levels", "entries", "features", "width", "layers", "base", "seed", "entry step", "weight step", "growth",
    "reach", "low x", "low y", "low z", "high x", "high y", "high z",
)  # fmt: skip


def field_state(size: int = 9) -> tuple[PlayerState, Field]:
    rng = np.random.default_rng(8)
    state = begin(rng, 30, 9)
    return state, make_field(rng, state.scene, 0.7, size)


def parts_of(field: Field, state: PlayerState) -> tuple[list[float], list[bytes]]:
    section = encode_delta(Delta((field,)), state.layout, {}, frame=1)
    data = section.data[16 + 5 :]
    return list(HEAD.unpack(data[: HEAD.size])), unpack_blobs(data[HEAD.size :], 7)


def lies():
    state, field = field_state()
    head, parts = parts_of(field, state)
    tail, number = pack_blobs(parts), len(state.gaussians)
    nan, inf = float("nan"), float("inf")

    def headed(**said):
        fields = dict(zip(NAMES, head, strict=True)) | {name.replace("_", " "): value for name, value in said.items()}
        return HEAD.pack(*fields.values()) + tail

    def parted(at, part):
        return HEAD.pack(*head) + pack_blobs([part if i == at else old for i, old in enumerate(parts)])

    for bits in (2, 4, 128, 255):
        yield f"flags {bits}", headed(flags=bits), "unknown flags"
    yield "marks, though none are said", headed(flags=0), "marks of rows"
    for name, most in (("levels", 16), ("entries", 20), ("features", 8), ("width", 128), ("layers", 4), ("base", 1024)):
        for wrong in (0, most + 1):
            yield f"{name} {wrong}", headed(**{name: wrong}), f"{name}: expected 1 to {most}"
    for name, most in (("entry", 1 << 25), ("weight", 1 << 17)):
        for wrong in (0, most + 1, 2**32 - 1):
            yield f"{name} step {wrong}", headed(**{f"{name}_step": wrong}), f"step of {name} symbols"
        yield f"the largest {name} step", headed(**{f"{name}_step": most}), "units in size"
    for wrong in (nan, inf, -1.0, 0.0, 4.5):
        yield f"growth {wrong}", headed(growth=wrong), "growth: expected a float32 from 1 to 4"
    for wrong in (nan, inf, 0.0, -0.0, -1.0, 1e9):
        yield f"reach {wrong}", headed(reach=wrong), "reach: expected"
    for wrong in (nan, inf, -inf, 2.0):
        yield f"box from {wrong}", headed(low_y=wrong), "box: expected"
    yield "an empty box", headed(high_z=head[NAMES.index("low z")]), "box: expected"
    yield "too many entries", headed(levels=16, entries=17), "at most 1048576 in all levels"
    yield "too many numbers", headed(levels=16, entries=4, features=8, layers=1) + b"", "."
    yield "cells without end", headed(levels=12, base=1024, growth=4.0), "cells along an axis"
    yield "another box", headed(low_x=-0.1), "."
    yield "more layers", headed(layers=4), "."
    yield "no marks", parted(0, b""), "."
    yield "marks with levels", parted(0, encode_gates(np.full(number, 2, np.uint8), 2)), "no levels"
    yield "marks of more rows", parted(0, encode_gates((np.arange(number + 1) % 2).astype(np.uint8), 1)), "gates"
    yield "other marks", parted(0, encode_gates((np.arange(number) < 2).astype(np.uint8), 1)), "."
    rows = len(field.entries[0])
    for at in (1, 2, 3):
        yield f"no entries in part {at}", parted(at, b""), "."
    yield "an entry more", parted(1, encode_symbols(np.arange(2 * rows + 2, dtype=np.int32).reshape(-1, 2))), "."
    beyond = encode_symbols(np.full((rows, 2), 1 << 11, np.int32))
    yield "entries beyond", parted(1, beyond), "entries of level 0: expected below"
    yield "weights beyond", parted(4, encode_symbols(np.full((6, 5), -(2**31), np.int32))), "layer 0: expected below"
    yield "a layer of another form", parted(5, encode_symbols(np.eye(6, dtype=np.int32))), "."
    for cut in range(0, HEAD.size, 7):
        yield f"cut after {cut} bytes", (HEAD.pack(*head))[:cut], "field cut short"
    yield "cut after the head", HEAD.pack(*head), "."
    yield "a byte more", HEAD.pack(*head) + tail + b"\0", "."


LIES = {name: (part, message) for name, part, message in lies()}


@pytest.mark.filterwarnings("error")
@pytest.mark.usefixtures("bounded_memory")
@pytest.mark.parametrize("lie", LIES)
def test_lies_about_a_field_are_refused_at_its_section(lie):
    state, field = field_state()
    before = [array.tobytes() for _, array in state.gaussians.items()]
    part, message = LIES[lie]
    data = replaced(encode_delta(Delta((field,)), state.layout, {}, frame=1), "field", part)
    with pytest.raises(PacketError, match=message) as caught:
        decode_packet(state, data, offset=1000)
    assert caught.value.offset == 1000 + 16 + 5
    assert str(caught.value).count("(at byte") == 1
    assert [array.tobytes() for _, array in state.gaussians.items()] == before


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
    assert field.shape.effort == 8 * 6 + 6 * 5 + 5 * 5 + 5 * 7
    monkeypatch.setattr("gsstream.core.changes.field.MAX_EFFORT", rows * field.shape.effort)
    decode_packet(state, packet.data)
    monkeypatch.setattr("gsstream.core.changes.field.MAX_EFFORT", rows * field.shape.effort - 1)
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
