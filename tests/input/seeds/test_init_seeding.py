"""Seeding: seeds lie on true surfaces, thinning keeps its budget."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gsstream.core.cameras import Cameras
from gsstream.core.errors import InputError, ShapeError
from gsstream.core.focus import focus_point
from gsstream.core.frame import PointCloud
from gsstream.core.projection import project, unproject
from gsstream.input.recordings.primitives import cast
from gsstream.input.recordings.synthetic import SyntheticSource
from gsstream.input.seeds import seeding
from gsstream.input.seeds.aggregate import aggregate, best_plane
from gsstream.input.seeds.fusion import agreement, color_gains, interpolate_depths
from gsstream.input.seeds.geometry import depth_range, neighbour_views, visible_views
from gsstream.input.seeds.seeding import photo_consistent_seeds
from gsstream.input.seeds.sweep import SweepSettings, sweep_depths
from gsstream.input.seeds.thinning import thin_points
from gsstream.testing.pretend import AVAILABLE, NAME

QUICK = SweepSettings(planes=64, neighbours=4)


@pytest.fixture(scope="module")
def scene() -> SyntheticSource:
    return SyntheticSource.from_query("width=96&height=72&views=10&noise=0.005")


@pytest.fixture
def without_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """The sweep alone: seeds of a room stand in where it is not sure, and have tests of their own."""
    monkeypatch.setattr(seeding, "stands_around", lambda _: False)


def surface_error(scene: SyntheticSource, points: np.ndarray) -> np.ndarray:
    """[P] relative depth error along the rays of the training camera that agrees best; inf where all are blocked."""
    cameras = scene.info.train
    shapes = scene._static + scene._scene.moving(0)
    error = np.full(len(points), np.inf)
    for center in cameras.centers:
        hits = cast(center, (points - center).astype(np.float32), shapes)
        error = np.minimum(error, np.abs(hits.distance - 1))
    return error


def cloud(xyz: np.ndarray, rgb: np.ndarray | None = None) -> PointCloud:
    colors = np.full_like(xyz, 0.5) if rgb is None else rgb
    return PointCloud(xyz.astype(np.float32), colors.astype(np.float32), "test")


def test_projection_inverts_and_visibility_follows(scene: SyntheticSource) -> None:
    cameras = scene.info.train
    rng = np.random.default_rng(0)
    uv, depth = rng.random((200, 2)) * (96, 72), rng.uniform(0.1, 5, 200)
    world = unproject(uv, depth, cameras, 3)
    again, z = project(world, cameras, 3)
    np.testing.assert_allclose(again, uv, atol=1e-9)
    np.testing.assert_allclose(z, depth)
    assert visible_views(world, cameras)[:, 3].all()
    behind = unproject(uv, -depth, cameras, 3)
    assert not visible_views(behind, cameras)[:, 3].any()
    assert visible_views(np.zeros((0, 3)), cameras).shape == (0, 10)


def test_the_rig_focus_is_where_it_looks(scene: SyntheticSource) -> None:
    cameras = scene.info.train
    np.testing.assert_allclose(focus_point(cameras), (0, 0, 0.4), atol=1e-3)
    partners = neighbour_views(cameras, 4)
    assert partners.shape == (10, 4)
    assert not (partners == np.arange(10)[:, None]).any()
    assert set(partners[5]) <= {3, 4, 6, 7}


def test_parallel_axes_still_have_a_finite_range() -> None:
    poses = np.repeat(np.eye(4)[None], 3, axis=0)
    poses[:, 0, 3] = (0, 1, 2)
    K = np.repeat(np.array([[50.0, 0, 16], [0, 50, 12], [0, 0, 1]])[None], 3, axis=0)
    near_far = depth_range(Cameras(("a", "b", "c"), poses, K, 32, 24))
    assert np.isfinite(near_far).all()
    assert (near_far[:, 0] > 0).all()
    assert (near_far[:, 0] < near_far[:, 1]).all()


@pytest.mark.usefixtures("without_room")
def test_dense_seeds_lie_on_the_true_surfaces(scene: SyntheticSource) -> None:
    images, cameras = scene.frame(0).images, scene.info.train
    seeds = photo_consistent_seeds(images, cameras, 4000, settings=QUICK)
    assert 3000 < len(seeds.points) <= 4000
    assert seeds.score.shape == (len(seeds.points),)
    assert ((seeds.score > 0) & (seeds.score <= 1)).all()
    error = surface_error(scene, seeds.points.xyz.astype(np.float64))
    # At 96 pixels two percent of the depth is half a pixel of parallax: the median is far better than that.
    assert np.median(error) < 0.012
    assert (error < 0.05).mean() > 0.88
    # The seeds explain most of what every camera sees; the ends of the arc see walls that nobody else sees.
    for view in range(len(cameras)):
        uv, depth = project(seeds.points.xyz.astype(np.float64), cameras, view)
        inside = (depth > 0) & (uv >= 0).all(1) & (uv < (96, 72)).all(1)
        column, row = (uv[inside] // 6).astype(int).T
        assert len(set(zip(column, row, strict=True))) > (0.85 if 2 <= view <= 7 else 0.7) * 16 * 12
    np.testing.assert_allclose(seeds.gains, 1, atol=0.03)


@pytest.mark.skipif(not AVAILABLE, reason="needs a process in which torch sees no GPU")
def test_depths_are_those_of_the_processor_on_a_device_that_takes_no_tensor_of_another(scene: SyntheticSource) -> None:
    images, cameras = scene.frame(0).images[:4], scene.info.train.select([0, 1, 2, 3])
    few = dataclasses.replace(QUICK, planes=16)
    there = sweep_depths(images, cameras, dataclasses.replace(few, device=torch.device(NAME)))
    np.testing.assert_allclose(there, sweep_depths(images, cameras, few), rtol=1e-5)


@pytest.mark.usefixtures("without_room")
def test_seeds_do_not_depend_on_threads_or_camera_gain(scene: SyntheticSource) -> None:
    images, cameras = scene.frame(0).images, scene.info.train
    one = photo_consistent_seeds(images, cameras, 1000, settings=dataclasses.replace(QUICK, planes=32, workers=1))
    two = photo_consistent_seeds(images, cameras, 1000, settings=dataclasses.replace(QUICK, planes=32, workers=3))
    assert one.points.xyz.tobytes() == two.points.xyz.tobytes()
    truth = np.random.default_rng(1).uniform(0.7, 1.1, (10, 3)).astype(np.float32)
    tinted = photo_consistent_seeds(images * truth[:, None, None], cameras, 4000, settings=QUICK)
    expected = truth / np.exp(np.log(truth).mean(0))
    np.testing.assert_allclose(tinted.gains, expected, rtol=0.03)
    error = surface_error(scene, tinted.points.xyz.astype(np.float64))
    assert np.median(error) < 0.012
    assert (error < 0.05).mean() > 0.88


def test_hopeless_input_is_explained(scene: SyntheticSource) -> None:
    images, cameras = scene.frame(0).images, scene.info.train
    with pytest.raises(InputError, match="at least 3 training cameras"):
        photo_consistent_seeds(images[:2], cameras.select([0, 1]), 10)
    with pytest.raises(ShapeError, match="images: expected shape"):
        photo_consistent_seeds(images[:, :-1], cameras, 10)
    poisoned = images.copy()
    poisoned[1, 2, 3, 0] = np.nan
    with pytest.raises(ShapeError, match="images: expected finite"):
        photo_consistent_seeds(poisoned, cameras, 10)


def test_true_depths_agree_and_false_ones_are_rejected(scene: SyntheticSource) -> None:
    cameras, depth = scene.info.train, scene.depth(0)
    true = agreement(depth, cameras, 0.02)
    assert true.accepted(2, 1.0).mean() > 0.85
    wrong = depth.copy()
    wrong[4] *= 0.6
    false = agreement(wrong, cameras, 0.02)
    assert false.accepted(2, 1.0)[4].mean() < 0.03
    assert false.violation[4].mean() > 2


def test_gains_of_cameras_that_share_nothing_are_one(scene: SyntheticSource) -> None:
    accepted = np.zeros((10, 72, 96), bool)
    gains = color_gains(scene.frame(0).images, scene.depth(0), accepted, scene.info.train)
    np.testing.assert_array_equal(gains, 1)


def test_bridging_reproduces_planes_exactly() -> None:
    row, column = np.mgrid[0:40, 0:60]
    inverse = 0.3 + 0.002 * column + 0.004 * row
    known = np.ones((1, 40, 60), bool)
    known[0, 10:22, 12:30] = False
    garbage = np.where(known, 1 / inverse, 77.0)
    filled = interpolate_depths(garbage, known)
    np.testing.assert_allclose(filled[0], 1 / inverse, rtol=2e-3)
    np.testing.assert_array_equal(filled[known], garbage[known])
    nothing = interpolate_depths(garbage, np.zeros_like(known))
    np.testing.assert_allclose(nothing, garbage)


def test_aggregation_matches_a_direct_evaluation() -> None:
    rng = np.random.default_rng(2)
    cost, guide = rng.random((5, 4, 6)).astype(np.float32), rng.random((4, 6)).astype(np.float32)
    total = aggregate(cost, guide, 0.1, 0.7)
    expected = np.zeros((5, 4, 6))
    for step_row, step_column in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        path = np.zeros((5, 4, 6))
        rows = range(4) if step_row >= 0 else range(3, -1, -1)
        columns = range(6) if step_column >= 0 else range(5, -1, -1)
        for y in rows:
            for x in columns:
                py, px = y - step_row, x - step_column
                path[:, y, x] = cost[:, y, x]
                if 0 <= py < 4 and 0 <= px < 6:
                    jump = max(0.7 / (1 + abs(float(guide[y, x]) - float(guide[py, px])) / 0.03), 0.15)
                    before = path[:, py, px]
                    for d in range(5):
                        near = [before[d]] + [before[k] + 0.1 for k in (d - 1, d + 1) if 0 <= k < 5]
                        path[d, y, x] += min(*near, before.min() + jump) - before.min()
        expected += path
    np.testing.assert_allclose(total, expected, rtol=1e-4)


def test_best_plane_finds_the_vertex_of_a_parabola() -> None:
    planes = np.arange(9)[:, None, None]
    vertex = np.array([[3.3, 0.0, 8.0, 5.5]])
    np.testing.assert_allclose(best_plane(((planes - vertex) ** 2).astype(np.float32)), vertex, atol=1e-5)


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 300), st.integers(1, 120), st.integers(0, 2**32 - 1), st.sampled_from([0.0, 1e-6, 1.0, 1e6]))
def test_thinning_keeps_its_budget_and_stays_inside(count: int, budget: int, seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    points = cloud(rng.normal(size=(count, 3)) * size + 3, rng.random((count, 3)))
    thin = thin_points(points, budget)
    assert 1 <= len(thin) <= budget
    assert thin.xyz.tobytes() == thin_points(points, budget).xyz.tobytes()
    margin = 1e-6 * (abs(points.xyz).max() + 1)
    assert (thin.xyz >= points.xyz.min(0) - margin).all()
    assert (thin.xyz <= points.xyz.max(0) + margin).all()
    assert ((thin.rgb >= 0) & (thin.rgb <= 1 + 1e-6)).all()
    if count <= budget:
        assert thin is points


def test_thinning_spends_more_on_texture_and_uses_the_budget() -> None:
    rng = np.random.default_rng(0)
    xyz = rng.random((20000, 3)) * (2, 1, 0)
    textured = xyz[:, 0] > 1
    rgb = np.where(textured[:, None], rng.random((20000, 3)), 0.5)
    thin = thin_points(cloud(xyz, rgb), 1000)
    assert 900 < len(thin) <= 1000
    assert (thin.xyz[:, 0] > 1).sum() > 2 * (thin.xyz[:, 0] < 1).sum()


def test_thinning_refuses_nonsense() -> None:
    with pytest.raises(InputError, match="max_points >= 1"):
        thin_points(cloud(np.zeros((3, 3))), 0)
    bad = np.zeros((30, 3))
    bad[3, 1] = np.inf
    with pytest.raises(ShapeError, match=r"points: expected finite values, got inf at index \[3, 1\]"):
        thin_points(cloud(bad), 10)
