"""The analytic scene: its truth agrees with its images."""

from __future__ import annotations

import numpy as np
import pytest

from gsstream.core.errors import SourceError
from gsstream.input.recordings.open import open_source
from gsstream.input.recordings.primitives import cast
from gsstream.input.recordings.synthetic import SyntheticSource

SMALL = "width=64&height=48&views=3&frames=20"


def make(query: str = "") -> SyntheticSource:
    return SyntheticSource.from_query(f"{SMALL}&{query}" if query else SMALL)


def to_pixels(source: SyntheticSource, points: np.ndarray, view: int) -> tuple[np.ndarray, np.ndarray]:
    cameras = source.info.train
    local = points @ cameras.viewmats[view, :3, :3].T + cameras.viewmats[view, :3, 3]
    uv = local @ cameras.Ks[view].T
    return uv[:, :2] / uv[:, 2:], local[:, 2]


def test_frames_are_valid_repeatable_and_eight_bit() -> None:
    source = make("noise=0.02")
    frame = source.frame(7)
    frame.validate()
    source.info.train.validate()
    assert frame.images.tobytes() == make("noise=0.02").frame(7).images.tobytes()
    levels = frame.images * 255
    np.testing.assert_allclose(levels, np.round(levels), atol=1e-4)
    assert 0.05 < frame.images.std() < 0.4


def test_seed_changes_the_scene_and_noise_has_its_sigma() -> None:
    assert not np.array_equal(make("seed=1").frame(0).images, make("seed=2").frame(0).images)
    clean, noisy = make("static=1").frame(3).images, make("static=1&noise=0.03").frame(3).images
    inside = (clean > 0.15) & (clean < 0.85)
    assert (noisy - clean)[inside].std() == pytest.approx(0.03, rel=0.05)
    assert not np.array_equal(noisy, make("static=1&noise=0.03").frame(4).images)


def test_static_means_bit_identical_and_motion_moves_only_near_objects() -> None:
    still = make("static=1")
    assert still.frame(0).images.tobytes() == still.frame(19).images.tobytes()
    moving = make("shadows=0")
    change = (moving.frame(0).images != moving.frame(9).images).any(-1)
    either = moving.moving_mask(0) | moving.moving_mask(9)
    assert change.sum() > 50
    assert not (change & ~either).any()


def test_masks_lie_where_the_objects_are_said_to_be() -> None:
    source = make("seed=5")
    for index in (0, 10, 19):
        mask, depth = source.moving_mask(index), source.depth(index)
        for center in source.object_positions(index).values():
            for view in range(3):
                uv, z = to_pixels(source, center[None], view)
                column, row = np.floor(uv[0]).astype(int)
                if 0 <= column < 64 and 0 <= row < 48 and depth[view, row, column] > z[0] - 0.3:
                    assert mask[view, row, column]
                    # The surface lies in front of the centre, by no more than the object's half diagonal.
                    assert z[0] - 0.24 < depth[view, row, column] < z[0]


def test_paths_are_smooth_and_speed_follows_motion() -> None:
    source, fast = make().object_positions, make("motion=2").object_positions
    path = np.stack([source(t)["ball"] for t in range(20)])
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    assert steps.min() > 0.02
    assert steps.max() < 0.13
    np.testing.assert_allclose(fast(5)["crate"], source(10)["crate"])


def test_depth_agrees_between_views() -> None:
    source = make()
    cameras, depth = source.info.train, source.depth(0)
    v, u = np.mgrid[0:48, 0:64] + 0.5
    pixels = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1)
    local = pixels @ np.linalg.inv(cameras.Ks[0]).T * depth[0].reshape(-1, 1)
    world = (local - cameras.viewmats[0, :3, 3]) @ cameras.viewmats[0, :3, :3]
    shapes = source._static + source._scene.moving(0)
    hits = cast(cameras.centers[1], (world - cameras.centers[1]).astype(np.float32), shapes)
    # From another camera the ray to a surface point ends there (parameter 1) or on something nearer, never behind.
    assert hits.distance.max() < 1.001
    assert (hits.distance > 0.999).mean() > 0.5


def test_points_lie_on_surfaces_and_carry_their_colour() -> None:
    source = make()
    points = source.points()
    depth, images = source.depth(0), source.frame(0).images
    error, color = np.full(len(points), np.inf), np.zeros((len(points), 3))
    for view in range(3):
        uv, z = to_pixels(source, points.xyz.astype(float), view)
        seen = np.flatnonzero((z > 0) & (uv >= 0).all(1) & (uv < (64, 48)).all(1))
        column, row = np.floor(uv[seen]).astype(int).T
        gap = np.abs(depth[view][row, column] - z[seen])
        better = gap < error[seen]
        error[seen[better]], color[seen[better]] = gap[better], images[view][row, column][better]
    assert np.median(error) < 0.01
    assert np.median(np.abs(color - points.rgb)) < 0.05
    assert len(source.points("sparse")) < len(points)


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("frame=3", "unknown option 'frame'; did you mean 'frames'"),
        ("frames=0", "option 'frames' = '0'"),
        ("frames=many", "option 'frames' = 'many'"),
        ("views=1", "option 'views'"),
        ("noise=-1", "option 'noise'"),
        ("frames", "expected key=value"),
        ("frames=2&frames=3", "more than once"),
        ("motion=nan", "option 'motion'"),
    ],
)
def test_wrong_options_are_explained(query: str, message: str) -> None:
    with pytest.raises(SourceError, match=message):
        open_source(f"synthetic:{query}")


def test_scale_and_extremes() -> None:
    assert open_source("synthetic:", 0.5).frame(0).images.shape == (8, 60, 80, 3)
    tiny = open_source("synthetic:?width=8&height=8&views=2&supersample=1&motion=20&frames=3")
    tiny.frame(2).validate()
    with pytest.raises(SourceError, match="has no frame 3"):
        tiny.frame(3)
