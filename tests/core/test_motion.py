"""Motions as geometry: what stays, what turns, how one frame predicts the next, and what becomes of groups."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from motion_oracle import World
from scipy.spatial.transform import Rotation

from gsstream.core.changes import (
    AddedGaussians,
    Delta,
    Groups,
    Layout,
    Motion,
    Residual,
    RowEdit,
    Scene,
    add_as_nodes,
    add_to_nodes,
    apply_delta,
    apply_motion,
    groups_for,
)
from gsstream.core.changes.motion import HALF_GRID, MAX_CELLS_PER_ROW
from gsstream.core.errors import ShapeError
from gsstream.core.gaussians import Gaussians

SEEDS = st.integers(0, 2**32 - 1)
NAMES = ("means", "quats")


def scene_of(means: object, quats: object = None, nodes: int = 1, sh0: object = 0.0) -> Scene:
    """A scene of these centres; all rows in the first of ``nodes`` nodes."""
    centres = np.asarray(means, np.float32).reshape(-1, 3)
    n = len(centres)
    turns = np.tile(np.float32([1, 0, 0, 0]), (n, 1)) if quats is None else np.asarray(quats, np.float32)
    colours = np.zeros((n, 1, 3), np.float32) + np.asarray(sh0, np.float32).reshape(-1, 1, 1)
    gaussians = Gaussians(
        centres, turns, np.zeros((n, 3), np.float32), np.zeros(n, np.float32), colours, np.zeros((n, 0, 3), np.float32)
    )
    counts = np.zeros(nodes, np.int32)
    counts[0] = n
    return Scene(gaussians, Layout(counts, np.zeros(n, np.uint8), np.float32([1])))


def random_scene(seed: int, number: int = 60, reach: float = 3.0) -> Scene:
    g = np.random.default_rng(seed)
    quats = g.normal(size=(number, 4))
    return scene_of(g.normal(size=(number, 3)) * reach, quats / np.linalg.norm(quats, axis=1)[:, None])


def move(scene: Scene, cell: float = 2.0, only: object = None, shift=(0, 0, 0), turn=(0, 0, 0), **said) -> Motion:
    """A motion of the groups ``only`` (all without), the same correction for each; steps 1/4 and 1/8."""
    groups = groups_for(scene, cell, 1, said.get("regroup", False))
    moving = np.ones(groups.count, np.uint8)
    if only is not None:
        moving = np.isin(np.arange(groups.count), only).astype(np.uint8)
    symbols = np.tile(np.int32([*shift, *turn]), (int(moving.sum()), 1))
    return Motion(cell, 1, moving, symbols, 0.25, 0.125, **said)


def play(scene: Scene, *changes: object) -> Scene:
    return apply_delta(scene, Delta(tuple(changes)))


def rotation(turn: object) -> Rotation:
    """What the symbols of a turn say: tan(angle / 2) = 1/8 for each."""
    vector = 0.125 * np.asarray(turn, float)
    length = np.linalg.norm(vector)
    return Rotation.from_rotvec(2 * np.arctan(length) * vector / (length or 1))


def orientations(scene: Scene) -> Rotation:
    return Rotation.from_quat(scene.gaussians.quats.astype(np.float64), scalar_first=True)


@given(SEEDS, st.integers(0, 5))
def test_rows_of_groups_that_stand_still_keep_every_bit(seed: int, group: int) -> None:
    scene = random_scene(seed)
    motion = move(scene, only=[group], shift=(3, 0, -2), turn=(1, 2, -1), predicted=False)
    after, rows = apply_motion(scene, motion)
    assert rows.tolist() == np.flatnonzero(after.groups.group_of == group).tolist() != []
    still = np.delete(np.arange(60), rows)
    for name, value in scene.gaussians.items():
        assert value[still].tobytes() == getattr(after.gaussians, name)[still].tobytes()
        if name not in NAMES:
            assert getattr(after.gaussians, name) is value
    assert not np.array_equal(after.gaussians.means[rows], scene.gaussians.means[rows])


@given(SEEDS)
def test_a_motion_of_no_group_changes_nothing_but_the_groups(seed: int) -> None:
    scene = random_scene(seed)
    nothing = move(scene, only=[], predicted=False)
    assert nothing.is_empty
    after = play(scene, nothing)
    assert after.gaussians is scene.gaussians
    assert after.displacement is None
    assert after.groups is not None


@given(SEEDS)
def test_an_identity_motion_keeps_the_bits_of_the_rows_it_moves(seed: int) -> None:
    """x - c + c in float64 loses less than float32 can say, but for coordinates much nearer to 0 than to the centre."""
    scene = random_scene(seed)
    after = play(scene, move(scene, predicted=False)).gaussians
    assert after.quats.tobytes() == scene.gaussians.quats.tobytes()
    before, apart = scene.gaussians.means, np.abs(scene.gaussians.means) >= 1e-6
    assert np.array_equal(after.means[apart], before[apart])
    assert np.abs(after.means - before).max() <= 1e-14


@given(SEEDS, st.tuples(*[st.integers(-40, 40)] * 3), st.tuples(*[st.integers(-40, 40)] * 3))
def test_a_motion_is_rigid(seed: int, shift: tuple, turn: tuple) -> None:
    """Distances within a group stay, to float32; quaternions keep their norm."""
    scene = random_scene(seed)
    after = play(scene, move(scene, cell=4.0, shift=shift, turn=turn, predicted=False))
    for group in range(after.groups.count):
        rows = np.flatnonzero(after.groups.group_of == group)
        old, new = (g.means[rows].astype(np.float64) for g in (scene.gaussians, after.gaussians))
        size = max(float(np.abs(old).max()), float(np.abs(new).max()))
        distances = [np.linalg.norm(x[:, None] - x[None], axis=2) for x in (old, new)]
        assert np.abs(distances[0] - distances[1]).max() <= 4 * 2.0**-24 * size
        centre = new.mean(0) - old.mean(0)
        np.testing.assert_allclose(centre, 0.25 * np.array(shift), atol=4 * 2.0**-24 * size)
    norms = [np.linalg.norm(g.quats.astype(np.float64), axis=1) for g in (scene.gaussians, after.gaussians)]
    assert np.abs(norms[0] - norms[1]).max() <= 3 * 2.0**-24


@given(SEEDS, st.lists(st.tuples(*[st.integers(-30, 30)] * 3), min_size=1, max_size=4))
def test_turns_compose_like_rotations_of_scipy(seed: int, turns: list) -> None:
    """Positions about the centre and orientations both turn by axis * tan(angle / 2), the later turn from the left."""
    scene = random_scene(seed, 20)
    motions, whole = [], Rotation.identity()
    for turn in turns:
        motions.append(move(scene, cell=1000.0, shift=(0, 0, 0), turn=turn, predicted=False))
        scene_groups = groups_for(scene, 1000.0, 1)
        whole = rotation(turn) * whole
    after = play(scene, *motions)
    for group in range(scene_groups.count):
        rows = np.flatnonzero(scene_groups.group_of == group)
        old = scene.gaussians.means[rows].astype(np.float64)
        wanted = whole.apply(old - old.mean(0)) + old.mean(0)
        np.testing.assert_allclose(after.gaussians.means[rows], wanted, atol=2e-5)
    before, now = orientations(scene), orientations(after)
    assert ((whole * before) * now.inv()).magnitude().max() < 5e-6


@given(st.tuples(*[st.integers(-8, 8)] * 3), st.integers(2, 6))
def test_prediction_continues_a_constant_velocity_exactly(velocity: tuple, frames: int) -> None:
    """With numbers that float32 holds, a group that was pushed once goes on by the same step without a symbol."""
    start = np.array([[0.0, 0, 0], [0.5, 0, 0], [0, 0.5, 0], [0.25, 0.25, 0]])
    scene = scene_of(start + 1)
    scene = play(scene, move(scene, shift=velocity, predicted=False))
    for frame in range(2, frames + 1):
        scene = play(scene, move(scene))
        wanted = (start + 1 + frame * 0.25 * np.array(velocity)).astype(np.float32)
        assert scene.gaussians.means.tobytes() == wanted.tobytes()


@given(SEEDS, st.tuples(*[st.integers(-3, 3)] * 3))
def test_prediction_continues_a_constant_turn(seed: int, turn: tuple) -> None:
    scene = random_scene(seed, 12)
    scene = play(scene, move(scene, cell=1000.0, turn=turn, predicted=False))
    first = scene
    for _ in range(3):
        scene = play(scene, move(scene, cell=1000.0))
    once = rotation(turn)
    before, now = orientations(first), orientations(scene)
    assert ((once**3 * before) * now.inv()).magnitude().max() < 1e-5


def test_a_group_is_predicted_by_the_mean_of_what_moved_in_it() -> None:
    """Rows that a residual moved count as well; rows that stood still do not."""
    scene = scene_of([[0.5, 0, 0], [0.5, 1, 0], [0.5, 1.5, 0]])
    scene = dataclasses.replace(scene, layout=Layout(np.int32([1, 1, 1]), np.zeros(3, np.uint8), np.float32([1])))
    table = np.int32([[1, 0, 0], [3, 0, 0]])
    scene = play(scene, Residual(np.uint8([1, 1, 0]), 1, {"means": table}, {"means": 0.25}))
    assert scene.displacement.rows.tolist() == [0, 1]
    after = play(scene, move(scene, cell=1000.0))
    assert (after.gaussians.means - scene.gaussians.means).tolist() == [[0.5, 0, 0]] * 3
    assert after.displacement.translation.tolist() == [[0.5, 0, 0]] * 3


def test_displacement_is_measured_over_the_whole_frame() -> None:
    """Motions there and back, and a residual: what is kept is the sum; a row that came home is not kept."""
    scene = scene_of([[0.5, 0, 0], [100.5, 0, 0]])
    there, back = (move(scene, shift=(s, 0, 0), predicted=False) for s in (4, -4))
    assert play(scene, there, back).displacement is None
    scene = dataclasses.replace(scene, layout=Layout(np.int32([1, 1]), np.zeros(2, np.uint8), np.float32([1])))
    home = Residual(np.uint8([1, 0]), 1, {"means": np.int32([[-4, 0, 0]])}, {"means": 0.25})
    after = play(scene, there, home)
    assert after.displacement.rows.tolist() == [1]
    assert after.displacement.translation.tolist() == [[1, 0, 0]]


def test_a_frame_without_motion_or_residual_forgets_displacements() -> None:
    scene = scene_of([[0.5, 0, 0], [0.5, 1, 0]])
    scene = play(scene, move(scene, shift=(1, 0, 0)))
    assert scene.displacement is not None
    assert play(scene, RowEdit(removed=np.array([0]))).displacement is None


@given(SEEDS)
def test_motions_of_different_groups_may_change_places(seed: int) -> None:
    """Groups are those of before the first motion, predictions those of the last frame: the order does not matter."""
    scene = random_scene(seed)
    scene = play(scene, move(scene, shift=(1, 2, 0), turn=(0, 0, 1), predicted=False))
    count = scene.groups.count
    one = move(scene, only=range(0, count, 2), shift=(5, 0, 0), turn=(1, 1, 0))
    two = move(scene, only=range(1, count, 2), shift=(0, -7, 0), turn=(0, -3, 0))
    first, second = play(scene, one, two), play(scene, two, one)
    for name, value in first.gaussians.items():
        assert value.tobytes() == getattr(second.gaussians, name).tobytes()
    both = move(scene, shift=(5, 0, 0), turn=(1, 1, 0))
    assert play(scene, both, one).gaussians.means.tobytes() != play(scene, one).gaussians.means.tobytes()


def test_a_later_motion_sees_where_the_earlier_one_led() -> None:
    """Turned about the centre where the group is then; formed anew from where the rows are then."""
    scene = scene_of([[0.5, 0.5, 0.5], [0.75, 0.5, 0.5]])
    away = move(scene, shift=(8, 0, 0), predicted=False)
    after = play(scene, away)
    again = move(after, shift=(0, 4, 0), regroup=True, predicted=False)
    assert play(scene, away, again).gaussians.means.tolist() == [[2.5, 1.5, 0.5], [2.75, 1.5, 0.5]]


def test_groups_stay_when_rows_leave_their_cells() -> None:
    scene = scene_of([[0.5, 0, 0], [10.5, 0, 0]])
    scene = play(scene, move(scene, only=[0], shift=(40, 0, 0), predicted=False))
    assert scene.gaussians.means[:, 0].tolist() == [10.5, 10.5]
    assert groups_for(scene, 2.0, 1).group_of.tolist() == [0, 1]
    assert groups_for(scene, 2.0, 1, regroup=True).group_of.tolist() == [0, 0]
    assert groups_for(scene, 2.5, 1).count == 1
    assert groups_for(scene, 2.0, 2).count == 1


def test_cells_and_shades_at_their_ends() -> None:
    far = [[-1e9, 0, 0], [-5e8, 0, 0], [1e9, 0, 0], [0, 0, 0], [-0.0, 0, 0], [-1e-30, 0, 0]]
    groups = groups_for(scene_of(far), 1.0, 1)
    assert groups.group_of.tolist() == [0, 0, 3, 2, 2, 1], "beyond the grid: its last cell; floor, not truncation"
    bright = groups_for(scene_of(np.zeros((5, 3)), sh0=[-9.0, -1e-6, 0.0, 1.7, 99.0]), 1.0, 16)
    assert bright.group_of.tolist() == [0, 1, 2, 3, 3]


@given(SEEDS, st.floats(1e-3, 1e5).map(np.float32), st.integers(1, 16))
def test_groups_are_those_of_the_text(seed: int, cell: np.float32, brightness_bins: int) -> None:
    g = np.random.default_rng(seed)
    scene = scene_of(g.normal(size=(40, 3)) * 10.0 ** g.integers(-2, 5), sh0=g.normal(size=40))
    world = World.of(scene.gaussians)
    world.form_groups(float(cell), brightness_bins, False)
    found = groups_for(scene, float(cell), brightness_bins)
    assert (found.group_of.tolist(), found.count) == (world.group_of, world.count)


def born(number: int, nodes: object) -> AddedGaussians:
    return add_to_nodes(scene_of(np.full((number, 3), 50.0)).gaussians, np.asarray(nodes), np.zeros(number, np.uint8))


def spread() -> Scene:
    """Three nodes of two rows; rows 0 to 5 in groups 0 to 5; all moved by 1, 2, ... along x."""
    scene = scene_of(np.arange(6)[:, None] * [10.0, 0, 0] + 0.5)
    layout = Layout(np.int32([2, 2, 2]), np.zeros(6, np.uint8), np.float32([1]))
    scene = dataclasses.replace(scene, layout=layout)
    motion = move(scene, predicted=False)
    symbols = np.zeros((6, 6), np.int32)
    symbols[:, 0] = 4 * (1 + np.arange(6))
    return play(scene, dataclasses.replace(motion, symbols=symbols))


def test_births_join_the_group_of_the_row_stored_before_them() -> None:
    after = play(spread(), RowEdit(born(3, [2, 0, 0])))
    assert after.groups.group_of.tolist() == [0, 1, 1, 1, 2, 3, 4, 5, 5]
    assert after.groups.count == 6
    assert after.displacement is None, "nothing moved in that frame"


def test_births_in_the_frame_of_a_motion_do_not_count_as_displaced() -> None:
    scene = spread()
    after = play(scene, move(scene), RowEdit(born(3, [2, 0, 0])))
    assert after.displacement.rows.tolist() == [0, 1, 4, 5, 6, 7]
    assert after.displacement.translation[:, 0].tolist() == [1, 2, 3, 4, 5, 6]
    following = play(after, move(after))
    step = following.gaussians.means[:, 0] - after.gaussians.means[:, 0]
    assert step.tolist() == [1, 2, 2, 2, 3, 4, 5, 6, 6], "what was added goes with its neighbours"


def test_deaths_take_rows_out_of_groups_and_displacements() -> None:
    scene = spread()
    after = play(scene, move(scene), RowEdit(removed=np.array([0, 3, 5])))
    assert after.groups.group_of.tolist() == [1, 2, 4]
    assert after.groups.count == 6, "groups keep their numbers, also empty ones"
    assert after.displacement.rows.tolist() == [0, 1, 2]
    assert after.displacement.translation[:, 0].tolist() == [2, 3, 5]
    following = play(after, move(after))
    assert (following.gaussians.means[:, 0] - after.gaussians.means[:, 0]).tolist() == [2, 3, 5]


def test_first_rows_that_are_born_join_the_first_old_row() -> None:
    scene = spread()
    after = play(scene, RowEdit(born(2, [0, 0]), np.array([0, 1])))
    assert after.gaussians.means[:2].tolist() == [[50] * 3] * 2
    assert after.groups.group_of.tolist() == [2, 2, 2, 3, 4, 5]


@pytest.mark.parametrize("births", [0, 3])
def test_without_an_old_row_the_groups_are_forgotten(births: int) -> None:
    new = add_as_nodes(scene_of(np.ones((3, 3))).gaussians, np.zeros(3), 3) if births else None
    after = play(spread(), RowEdit(new, np.arange(6)))
    assert after.groups is None
    assert play(after, move(after, predicted=True)).groups.count == (1 if births else 0)


@given(SEEDS)
def test_a_turn_beyond_120_degrees_counts_as_none(seed: int) -> None:
    """The Gaussian was painted anew. The sign of a quaternion is no turn."""
    g = np.random.default_rng(seed)
    axis = g.normal(size=3)
    axis /= np.linalg.norm(axis)
    scene = scene_of([[0.5, 0.5, 0.5]], [[1, 0, 0, 0]])
    for degrees, known in ((1, True), (119.9, True), (120.1, False), (180, False), (359, True)):
        half = np.deg2rad(degrees) / 2
        quat = np.array([np.cos(half), *(np.sin(half) * axis)]) * g.choice([-3.0, 0.2])
        change = (quat - [1, 0, 0, 0]).astype(np.float32)
        residual = Residual(np.uint8([1]), 1, {"quats": np.int32([[1]])}, {"quats": 1.0}, {"quats": change[None]})
        after = play(scene, residual)
        if not known:
            assert after.displacement is None
        else:
            wanted = axis * np.tan(half)
            np.testing.assert_allclose(after.displacement.rotation[0], wanted, atol=3e-6)
            assert after.displacement.translation.tolist() == [[0, 0, 0]]


def test_misfits_are_refused_in_words() -> None:
    scene = spread()
    motion = move(scene)
    bad = {
        "a mark for each of 6 groups": dataclasses.replace(motion, moving=motion.moving[:-1]),
        "6 symbols for each of 6 moving groups": dataclasses.replace(motion, symbols=motion.symbols[:-1]),
        "beyond the range of float32": dataclasses.replace(
            motion, symbols=motion.symbols + 2**30, translation_step=1e38
        ),
    }
    for message, wrong in bad.items():
        with pytest.raises(ShapeError, match=message):
            play(scene, wrong)
    assert isinstance(scene.groups, Groups)


ROWS, CELL = 300, 0.25


@pytest.mark.parametrize("reach", [1.0, 30.0, 1e7])
@pytest.mark.parametrize("brightness_bins", [1, 5])
def test_groups_are_those_of_the_text_by_a_table_and_by_sorting(reach: float, brightness_bins: int) -> None:
    """Rows whose cells fit into a table, rows too far apart for one, and rows beyond the end of the grid."""
    rng = np.random.default_rng(2)
    means = (reach * rng.uniform(-1, 1, (ROWS, 3)) ** 3).astype(np.float32)
    colours = rng.normal(size=(ROWS, 1, 3)).astype(np.float32)
    gaussians = Gaussians(means, np.ones((ROWS, 4), np.float32), means, means[:, 0], colours, colours[:, :0])
    layout = Layout(np.array([ROWS], np.int32), np.zeros(ROWS, np.uint8), np.float32([1]))
    groups = groups_for(Scene(gaussians, layout), CELL, brightness_bins)

    index = np.floor(means.astype(np.float64) / CELL)
    cells = np.clip(index, -HALF_GRID, HALF_GRID - 1).astype(int)
    assert (np.ptp(cells, axis=0).prod() > MAX_CELLS_PER_ROW * ROWS) == (reach > 1), "both ways are looked at"
    world = World.of(gaussians)
    world.form_groups(CELL, brightness_bins, False)
    assert groups.group_of.dtype == np.int32
    assert (groups.group_of.tolist(), groups.count) == (world.group_of, world.count)
