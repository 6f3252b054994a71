"""Fields in packets: round trips, a second decoder written from the text, sums that no order of adding can change."""

from __future__ import annotations

import dataclasses
import subprocess
import sys

import field_oracle as oracle
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from packet_scenes import begin, decode_all, follow, make_delta, make_field, make_field_packets, make_motion

from gsstream.core.changes import Delta, FieldShape, RowEdit, Scene, apply_delta, apply_field, apply_motion, field_rows
from gsstream.core.changes.hashgrid import evaluate_network
from gsstream.core.errors import ShapeError
from gsstream.packet import decode_delta, encode_delta

SHAPES = st.fixed_dictionaries({
    "levels": st.integers(1, 5), "entries": st.integers(1, 9), "features": st.integers(1, 3), "base": st.integers(1, 9),
    "growth": st.sampled_from([1.0, 1.25, float(np.float32(1.38)), 2.0, 4.0]), "width": st.integers(1, 9),
    "layers": st.integers(1, 4), "seed": st.integers(0, 2**32 - 1),
})  # fmt: skip


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), SHAPES, st.sampled_from([None, 0.0, 0.5, 1.0]), st.sampled_from([0, 3, 500]))
def test_a_player_has_what_the_text_says(seed, said, share, size):
    """Bit for bit, and what the packet says is what was put into it."""
    rng = np.random.default_rng(seed)
    state = begin(rng, 12, 5)
    field = make_field(rng, state.scene, share, size, **said)
    packet = encode_delta(Delta((field,)), state.layout, {}, frame=1)
    read = decode_delta(packet.data, state.scene, {}).field
    assert read.shape == field.shape
    assert [table.tolist() for table in read.entries] == [table.tolist() for table in field.entries]
    assert [table.tolist() for table in read.weights] == [table.tolist() for table in field.weights]
    assert (read.marks is None) == (share is None)
    after = follow(state, Delta((field,))).gaussians
    means, quats = oracle.apply(field, state.gaussians.means.tolist(), state.gaussians.quats.tolist())
    assert np.array(means, np.float32).tobytes() == after.means.tobytes()
    assert np.array(quats, np.float32).tobytes() == after.quats.tobytes()
    for name in ("scales", "opacities", "sh0", "shN"):
        assert getattr(after, name) is getattr(state.gaussians, name) or np.array_equal(
            getattr(after, name), getattr(state.gaussians, name)
        )


def test_something_moves_and_what_lies_outside_keeps_its_bits():
    """Without this the test above would prove nothing."""
    rng = np.random.default_rng(1)
    state = begin(rng, 200, 9)
    field = make_field(rng, state.scene, None)
    after, rows = apply_field(state.scene, field)
    moved = np.abs(after.gaussians.means - state.gaussians.means).max(1)
    low, high = np.array(field.shape.low), np.array(field.shape.high)
    inside = ((state.gaussians.means >= low) & (state.gaussians.means <= high)).all(1)
    assert 20 < inside.sum() < 180
    assert rows.tolist() == np.flatnonzero(inside).tolist()
    assert (moved[inside] > 0).mean() > 0.7
    assert not moved[~inside].any()
    assert np.array_equal(after.gaussians.quats[~inside], state.gaussians.quats[~inside])
    assert np.allclose(np.linalg.norm(after.gaussians.quats, axis=1), np.linalg.norm(state.gaussians.quats, axis=1))


def test_before_anything_is_learned_nothing_moves():
    rng = np.random.default_rng(2)
    state = begin(rng, 50, 9)
    after, rows = apply_field(state.scene, make_field(rng, state.scene, None, size=0))
    assert len(rows) > 10
    assert after.gaussians.means.tobytes() == state.gaussians.means.tobytes()
    np.testing.assert_array_equal(after.gaussians.quats, state.gaussians.quats)


def largest(signs: np.random.Generator | None) -> tuple[FieldShape, np.ndarray, list[np.ndarray], list[np.ndarray]]:
    """The largest network of the format, every number as large as it may be: all alike, or of random signs."""
    shape = FieldShape((0.0,) * 3, (1.0,) * 3, 1.0, 16, 4, 8, 2, 1.25, 128, 4)
    unit = np.random.default_rng(5).random((300, 3))

    def full(form: tuple[int, int], most: int) -> np.ndarray:
        sign = np.ones(form, np.int64) if signs is None else signs.choice([-1, 1], form)
        return np.asarray(sign * (most - 1))

    entries = [full((len(which), 8), 1 << 26) for which in shape.touched(unit)]
    pairs = zip(shape.widths[:-1], shape.widths[1:], strict=True)
    return shape, unit, entries, [full(pair, 1 << 18) for pair in pairs]


@pytest.mark.parametrize("seed", [None, 0, 1])
def test_sums_are_exact_at_the_limits_of_the_format(seed):
    """The network by matrices of int64, which no library of linear algebra touches, agrees in every bit."""
    shape, unit, entries, weights = largest(None if seed is None else np.random.default_rng(seed))
    touched = shape.touched(unit)
    got = evaluate_network(shape, unit, touched, entries, weights)
    # Inputs as the look-up makes them: the network whose layers are one is asked for them, number by number.
    values = np.empty((len(unit), 128), np.int64)
    for level, table in enumerate(entries):
        index, near = shape.corners(unit, level)
        rank = np.searchsorted(touched[level], index)
        for number in range(8):
            total = near[0] * table[rank[0], number]
            for corner in range(1, 8):
                total = total + near[corner] * table[rank[corner], number]
            values[:, 8 * level + number] = np.floor(total + 0.5).astype(np.int64)
    for number, layer in enumerate(weights):
        values = values @ layer
        assert int(np.abs(values).max()) < 1 << 53
        if number < shape.layers:
            values = np.clip((values + (1 << 13)) >> 14, 0, (1 << 26) - 1)
    assert np.array_equal(got * 2.0**34, values)
    for some in (slice(0, 1), slice(0, 7), slice(3, 300)):  # other shapes, other kernels of the library
        assert evaluate_network(shape, unit[some], touched, entries, weights).tobytes() == got[some].tobytes()


def test_blocks_of_rows_do_not_show(monkeypatch):
    rng = np.random.default_rng(6)
    state = begin(rng, 300, 9)
    field = make_field(rng, state.scene, None)
    whole = apply_field(state.scene, field)[0].gaussians
    monkeypatch.setattr("gsstream.core.changes.hashgrid.BLOCK", 7)
    parts = apply_field(state.scene, field)[0].gaussians
    assert whole.means.tobytes() == parts.means.tobytes()
    assert whole.quats.tobytes() == parts.quats.tobytes()


def test_a_field_stands_between_motion_and_the_rest():
    """It looks up where the motion led; what moved is measured over both."""
    rng = np.random.default_rng(7)
    state = begin(rng, 60, 9)
    motion = make_motion(rng, state.scene, predicted=False)
    there, rows = apply_motion(state.scene, motion)
    field = make_field(rng, there)
    residual = make_delta(rng, state.layout, latent=False).residual
    delta = Delta((motion, field)).with_row_edit(RowEdit(removed=np.array([3]))).with_residual(residual)
    assert [type(change).__name__ for change in delta.changes] == ["Motion", "Field", "Residual", "RowEdit"]
    after = follow(state, delta)
    assert after.delta.field is not None
    alone, moved = apply_field(there, field)
    both = apply_delta(state.scene, Delta((motion, field)))
    assert both.gaussians.means.tobytes() == alone.gaussians.means.tobytes()
    assert set(moved) & set(both.displacement.rows.tolist())
    assert set(both.displacement.rows.tolist()) <= set(rows.tolist()) | set(moved.tolist())
    np.testing.assert_array_equal(
        both.displacement.translation,
        alone.gaussians.means[both.displacement.rows] - state.gaussians.means[both.displacement.rows],
    )
    with pytest.raises(ShapeError, match="one field"):
        Delta((field, field))
    with pytest.raises(ShapeError, match="one field"):
        Delta((field, motion))


def test_a_row_on_a_face_of_the_box_is_inside():
    rng = np.random.default_rng(8)
    shape = make_field(rng, begin(rng).scene).shape
    state = begin(rng, 4, 2)
    beyond = np.nextafter(np.float32(shape.high), np.float32(9))
    edge = np.array([shape.low, shape.high, beyond, (3e38,) * 3], np.float32)
    scene = Scene(dataclasses.replace(state.gaussians, means=edge), state.layout)
    rows, unit = field_rows(scene, shape, None)
    assert rows.tolist() == [0, 1]
    assert unit.tolist() == [[0.0] * 3, [1.0] * 3]
    for level in range(shape.levels):
        index, near = shape.corners(unit, level)
        assert near.max(0).tolist() == [1.0, 1.0]
        assert int(index.max()) < 1 << shape.entries


def test_starts_are_drawn_evenly_and_differ_by_seed():
    shape = FieldShape((0.0,) * 3, (1.0,) * 3, 1.0, 4, 15, 4, 16, 2.0, 64, 2, seed=1)
    entries = shape.start_entries(3, np.arange(1 << 15))
    assert (int(entries.min()), int(entries.max())) == (-105, 105)
    assert abs(float(entries.mean())) < 0.5
    assert np.bincount((entries + 105).ravel()).min() > 0.8 * entries.size / 211
    first, second, last = shape.start_weights()
    for layer, inner in ((first, 16), (second, 64)):
        assert abs(float(layer.std()) / 2**14 / (2 / inner) ** 0.5 - 1) < 0.05
    assert not last.any()
    other = dataclasses.replace(shape, seed=2).start_weights()[0]
    assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < 0.1
    assert abs(np.corrcoef(entries[:-1, 0], entries[1:, 0])[0, 1]) < 0.03


def test_two_players_agree_where_libraries_use_other_threads():
    """The digest of a stream, in processes that let the library of linear algebra use one thread and two."""
    code = (
        "import hashlib\nfrom packet_scenes import decode_all, make_field_packets\n"
        "states = decode_all(make_field_packets(seed=3, number=900, nodes=9))\n"
        "print(hashlib.sha256(b''.join(v.tobytes() for s in states for _, v in s.gaussians.items())).hexdigest())"
    )
    found = set()
    for threads in ("1", "2"):
        env = {"OPENBLAS_NUM_THREADS": threads, "OMP_NUM_THREADS": threads, "PYTHONPATH": ":".join(sys.path)}
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=600, env=env)
        found.add(done.stdout)
    assert len(found) == 1


def test_the_stream_of_the_samples_says_every_form_of_field():
    states = decode_all(make_field_packets(seed=4, **{"number": 30, "nodes": 9}))
    kinds = [[type(change).__name__ for change in state.delta.changes] for state in states[1:]]
    assert kinds[2][:2] == ["Motion", "Field"]
    assert {state.delta.field.marks is None for state in states[1:] if state.delta.field} == {True, False}
