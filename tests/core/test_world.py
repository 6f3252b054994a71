"""Similarities between a stream and its recording, and the world that a rig defines for itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsstream.core.cameras import Cameras
from gsstream.core.errors import ShapeError
from gsstream.core.frame import PointCloud
from gsstream.core.gaussians import Gaussians
from gsstream.core.world import IDENTITY, World, rig_similarity, snap_cameras
from gsstream.player.software import render_numpy
from tests.rigs import looking

K = np.array([[60.0, 0, 24], [0, 60.0, 18], [0, 0, 1]])


def rotation(quaternion: np.ndarray) -> np.ndarray:
    """By Rodrigues' formula, so that it shares nothing with the code under test."""
    w, *axis = quaternion / np.linalg.norm(quaternion)
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def similarity(seed: int, scale: float = 1.0, shift: float = 0.0) -> World:
    rng = np.random.default_rng(seed)
    turn = rotation(rng.normal(size=4))
    return World(tuple(turn.reshape(-1).tolist()), tuple((shift * rng.normal(size=3)).tolist()), scale)


def rig(eyes: np.ndarray, target=(0.0, 0.0, 0.0), up=(0.0, 0.0, 1.0), names=None) -> Cameras:
    return looking(eyes, target, up, K, (48, 36), names=names)


def ring(number: int) -> np.ndarray:
    angle = 2 * np.pi * np.arange(number) / number
    return np.stack([3 * np.cos(angle), 3 * np.sin(angle), np.full(number, 1.5)], 1)


def rolled(cameras: Cameras) -> Cameras:
    """Every camera rolled by another multiple of a right angle: their up directions cancel out."""
    turns = [rotation(np.array([np.cos(a / 2), 0, 0, np.sin(a / 2)])) for a in np.pi / 2 * np.arange(len(cameras))]
    viewmats = cameras.viewmats.copy()
    viewmats[:, :3] = np.einsum("cij,cjk->cik", turns, viewmats[:, :3])
    return replace(cameras, viewmats=viewmats)


TURN_ONLY = np.array([[1.0, 1, 1, 0], [1, 1, 1, 0], [1, 1, 1, 0], [1, 1, 1, 1]])
DOWN = rig(np.array([[0.0, 0, 4], [1, 0, 4], [0, 1, 4]]), up=(0, 1, 0))
DOWN.viewmats[:, :3, :3] = DOWN.viewmats[0, :3, :3]
DOWN.viewmats[:, :3, 3] = -np.einsum("cij,cj->ci", DOWN.viewmats[:, :3, :3], [[0, 0, 4], [1, 0, 4], [0, 1, 4]])
#: Rigs whose axes are hard to choose: full turns, parallel axes, cameras that look down, one camera.
RIGS = {
    "arc": rig(ring(12)[:5]), "ring": rig(ring(8)), "ring of 3": rig(ring(3)), "grid": rig(
        np.stack([np.tile([0.0, 1, 2], 2), np.full(6, -4.0), np.repeat([0.0, 1], 3)], 1), target=(1.0, 1e6, 0.5)
    ),
    "looking down": DOWN, "rolled": rolled(rig(ring(4))), "outwards": rig(0.1 * ring(6), target=(0, 0, 50.0)),
    "one": rig(ring(1)), "one place": replace(rig(ring(4)), viewmats=rig(ring(4)).viewmats * TURN_ONLY),
}  # fmt: skip
POINTS = PointCloud(np.random.default_rng(0).normal(size=(50, 3)), np.full((50, 3), 0.5, np.float32), "test")

worlds = st.builds(
    similarity, st.integers(0, 10**6), st.floats(-6, 9).map(lambda e: 10.0**e), st.just(0.0) | st.floats(1, 1e7)
)


@pytest.mark.parametrize("name", RIGS)
@settings(max_examples=25, deadline=None)
@given(where=worlds)
def test_a_rig_defines_the_same_world_wherever_it_stands(name, where):
    where = replace(where, offset=tuple(where.scale * value for value in where.offset))  # up to 1e7 rig sizes
    here, there = RIGS[name], where.cameras(RIGS[name])
    moved = replace(POINTS, xyz=where.points(POINTS.xyz))
    own, theirs = rig_similarity(here, lambda: POINTS), rig_similarity(there, lambda: moved)
    known = 1e-9 * max(1.0, np.abs(where.offset).max() / where.scale / 1e5)  # float64 far from the origin
    assert theirs.inverse_cameras(there).viewmats == pytest.approx(own.inverse_cameras(here).viewmats, abs=known)
    assert theirs.inverse_points(moved.xyz) == pytest.approx(own.inverse_points(POINTS.xyz), abs=10 * known)
    assert theirs.is_near(where.after(own))


@pytest.mark.parametrize("name", RIGS)
def test_a_rigs_own_world_is_upright_and_of_unit_size(name):
    own = rig_similarity(RIGS[name], lambda: POINTS)
    own.validate()
    placed = own.inverse_cameras(RIGS[name])
    assert placed.centers.mean(0) == pytest.approx(np.zeros(3), abs=1e-9)
    if name not in ("one", "one place"):
        assert placed.extent == pytest.approx(1)
    if name in ("arc", "ring", "ring of 3", "grid"):
        assert own.matrix[:, 2] == pytest.approx([0, 0, 1], abs=1e-9), "z is up"
    if name in ("arc", "grid", "one"):
        ahead = placed.viewmats[:, 2, :3].mean(0)
        assert ahead[0] > 0.2
        assert ahead[1] == pytest.approx(0, abs=1e-9), "x is where the cameras look"


@pytest.mark.parametrize("name", RIGS)
def test_the_order_of_the_cameras_does_not_matter(name):
    cameras = RIGS[name]
    backwards = cameras.select(range(len(cameras))[::-1])
    assert rig_similarity(backwards, lambda: POINTS) == rig_similarity(cameras, lambda: POINTS)


def test_a_rig_without_extent_is_measured_by_its_points():
    cameras = RIGS["one place"]
    distance = np.median(np.linalg.norm(POINTS.xyz - cameras.centers.mean(0), axis=1))
    assert rig_similarity(cameras, lambda: POINTS).scale == pytest.approx(distance)
    assert rig_similarity(cameras).scale == 1
    empty = replace(POINTS, xyz=POINTS.xyz[:0])
    assert rig_similarity(cameras, lambda: empty).scale == 1
    assert rig_similarity(cameras.select([])) == IDENTITY


def test_rotations_that_are_rounded_do_not_move_cameras_of_a_far_rig():
    """Poses are often written with six digits: an orthogonal inverse of them would be metres off in UTM coordinates."""
    far = similarity(3, 1.0, 5e6).cameras(RIGS["arc"])
    rounded = replace(far, viewmats=far.viewmats.copy())
    rounded.viewmats[:, :3, :3] = np.round(far.viewmats[:, :3, :3], 6)
    own = rig_similarity(rounded)
    # What a file with such rotations says: x_camera = R x + t, with R as it is written.
    points = far.centers.mean(0) + np.random.default_rng(1).normal(size=(20, 3))
    seen = np.einsum("cij,nj->cni", rounded.viewmats[:, :3, :3], points) + rounded.viewmats[:, None, :3, 3]
    placed = own.inverse_cameras(rounded)
    again = np.einsum("cij,nj->cni", placed.viewmats[:, :3, :3], own.inverse_points(points))
    again += placed.viewmats[:, None, :3, 3]
    assert own.scale * again == pytest.approx(seen, abs=1e-6)


@settings(max_examples=25, deadline=None)
@given(first=worlds, second=worlds)
def test_worlds_invert_and_follow_each_other(first, second):
    xyz = np.random.default_rng(1).normal(size=(8, 3))
    lost = 1e-14 * (1 + np.abs(first.offset).max() / first.scale)  # float64 far from the origin
    assert first.inverse_points(first.points(xyz)) == pytest.approx(xyz, abs=lost)
    chained, direct = first.after(second).points(xyz), first.points(second.points(xyz))
    assert chained == pytest.approx(direct, rel=1e-9, abs=1e-12 * np.abs(direct).max())
    there = first.inverse().points(first.points(xyz))
    assert there == pytest.approx(xyz, abs=lost)


def scene(rng: np.random.Generator, rest: int) -> Gaussians:
    number = 60
    return Gaussians(
        means=0.5 * rng.normal(size=(number, 3)),
        quats=rng.normal(size=(number, 4)),
        scales=np.log(rng.uniform(0.03, 0.3, (number, 3))),
        opacities=rng.normal(size=number),
        sh0=rng.normal(size=(number, 1, 3)),
        shN=0.5 * rng.normal(size=(number, rest, 3)),
    )


def picture(gaussians: Gaussians, cameras: Cameras, view: int) -> np.ndarray:
    arrays = [array for _, array in gaussians.items()]
    return render_numpy(arrays, cameras.viewmats[view], cameras.Ks[view], 48, 36, near=cameras.near_plane)


@pytest.mark.parametrize("rest", [0, 3, 8, 15])
def test_a_moved_scene_shows_the_same_pictures_to_moved_cameras(rest):
    """The renderer knows nothing of worlds: positions, sizes, rotations and view-dependent colours must agree."""
    gaussians, cameras = scene(np.random.default_rng(rest), rest), RIGS["ring of 3"]
    where = similarity(rest, 250.0, 40.0)
    moved, away = where.gaussians(gaussians), where.cameras(cameras)
    for view in range(3):
        before, after = picture(gaussians, cameras, view), picture(moved, away, view)
        assert before.std() > 0.05
        assert after == pytest.approx(before, abs=2e-5)
        unturned = picture(replace(moved, shN=gaussians.shN), away, view)
        assert rest == 0 or np.abs(unturned - before).max() > 0.01, "colours that do not turn would be seen"


def test_the_identity_changes_no_bit():
    gaussians = scene(np.random.default_rng(0), 8).map(lambda a: a.astype(np.float32))
    assert IDENTITY.gaussians(gaussians) is gaussians
    assert np.array_equal(IDENTITY.points(gaussians.means), gaussians.means)


def test_rounded_poses_are_still_rotations_and_forget_the_noise():
    cameras = RIGS["ring"]
    noise = np.random.default_rng(0).uniform(-1e-13, 1e-13, cameras.viewmats.shape)
    rounded = snap_cameras(cameras)
    assert np.abs(rounded.viewmats - cameras.viewmats).max() < 4 * 2.0**-30
    turns = rounded.viewmats[:, :3, :3]
    assert turns @ turns.transpose(0, 2, 1) == pytest.approx(np.tile(np.eye(3), (8, 1, 1)), abs=1e-15)
    assert np.array_equal(snap_cameras(replace(cameras, viewmats=cameras.viewmats + noise)).viewmats, rounded.viewmats)


def test_poses_that_the_calibration_rounded_stay_as_they_are_to_the_grid():
    """Three digits are no rotation to 1e-8: a step to the nearest one would change what was calibrated."""
    cameras = replace(RIGS["ring"], viewmats=np.round(RIGS["ring"].viewmats, 3))
    assert np.abs(snap_cameras(cameras).viewmats - cameras.viewmats).max() <= 2.0**-30


@pytest.mark.parametrize(
    "fault",
    [
        {"scale": 0.0},
        {"scale": -1.0},
        {"scale": np.inf},
        {"scale": np.nan},
        {"offset": (0.0, np.nan, 0.0)},
        {"offset": (0.0,)},
        {"rotation": (1.0,) * 9},
        {"rotation": (-1.0, 0, 0, 0, 1, 0, 0, 0, 1)},
        {"rotation": IDENTITY.rotation[:8]},
    ],
)
def test_what_is_no_similarity_is_refused(fault):
    with pytest.raises(ShapeError, match="world"):
        replace(IDENTITY, **fault).validate()
