"""The analytic scene: its truth agrees with its images, and its events happen when they are asked for."""

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


EVENT = 5


def scene(name: str, **more: object) -> SyntheticSource:
    options = {"scene": name, "event": EVENT, "frames": 20, "width": 48, "height": 36, "views": 3, "supersample": 1}
    source = open_source("synthetic:" + "&".join(f"{key}={value}" for key, value in {**options, **more}.items()))
    assert isinstance(source, SyntheticSource)
    return source


def track(source: SyntheticSource, name: str = "ball") -> np.ndarray:
    return np.stack([source.object_positions(t)[name] for t in range(20)])


def test_what_stops_stands_still_from_the_event_on_and_goes_the_usual_way_before() -> None:
    stop, paths = scene("stop"), scene("paths")
    np.testing.assert_array_equal(track(stop)[: EVENT + 1], track(paths)[: EVENT + 1])
    assert (track(stop)[EVENT:] == track(stop)[EVENT]).all()
    assert stop.frame(EVENT).images.tobytes() == stop.frame(19).images.tobytes()
    assert stop.frame(EVENT - 1).images.tobytes() != stop.frame(EVENT).images.tobytes()


def test_the_first_event_is_that_of_frame_1() -> None:
    stop = scene("stop", event=1)
    assert (track(stop)[1:] == track(stop)[1]).all()
    assert (track(stop)[0] != track(stop)[1]).any()
    with pytest.raises(SourceError, match=r"event.*greater than or equal to 1"):
        scene("stop", event=0)


def test_what_turns_back_shows_its_pictures_in_the_reverse_order() -> None:
    source = scene("reversal")
    for step in range(1, EVENT + 1):
        assert source.frame(EVENT + step).images.tobytes() == source.frame(EVENT - step).images.tobytes()


def test_what_bounces_meets_the_floor_at_the_event_with_constant_speed() -> None:
    steps = np.diff(track(scene("bounce")), axis=0)[:12]
    assert track(scene("bounce"))[EVENT, 2] == pytest.approx(0.18), "its radius: it touches the floor"
    np.testing.assert_allclose(np.abs(steps[:, 2]), 0.08, atol=1e-9)
    np.testing.assert_array_equal(np.sign(steps[:, 2]), [-1] * EVENT + [1] * 7)
    # Nothing at rest is where it passes.
    assert track(scene("bounce", event=13))[:, 2].max() <= 0.18 + 0.72 + 1e-9


def test_what_is_hidden_is_hidden_from_every_camera_and_comes_out_again() -> None:
    source = scene("occlusion")
    seen = [source.moving_mask(t).any((1, 2)) for t in range(20)]
    assert seen[0].sum() >= 2
    assert not np.array([seen[t] for t in range(EVENT, EVENT + 5)]).any(), "hidden from all of them"
    assert seen[16].sum() >= 2


def test_a_flash_lights_one_frame_of_all_cameras_and_moves_nothing() -> None:
    flash, paths = scene("flash"), scene("paths")
    for index in (0, EVENT - 1, EVENT + 1, 19):
        assert flash.frame(index).images.tobytes() == paths.frame(index).images.tobytes()
    for split in ("train", "test"):
        dark, bright = paths.frame(EVENT, split).images, flash.frame(EVENT, split).images
        np.testing.assert_allclose(bright, np.minimum(1.6 * dark, 1), atol=1.6 / 255)


@pytest.mark.parametrize(("name", "later"), [("lamp", [1.3] * 3), ("dim", [1.0, 0.9975, 0.995])])
def test_the_light_stays_changed_and_nothing_else_does(name: str, later: list[float]) -> None:
    changed, paths = scene(name), scene("paths")
    for index, factor in zip(range(EVENT - 1, EVENT + 3), [1.0, *later], strict=True):
        for split in ("train", "test"):
            before, after = paths.frame(index, split).images, changed.frame(index, split).images
            # Both are rounded to 8 bits; what white was before it was cut off is not known.
            known = before < 1
            wanted = np.minimum(before * factor, 1)
            np.testing.assert_allclose(after[known], wanted[known], atol=1.2 / 255, rtol=0)
        for body, center in paths.object_positions(index).items():
            assert np.array_equal(center, changed.object_positions(index)[body])


def test_a_cloud_darkens_one_side_of_the_room_and_no_place_of_the_other() -> None:
    """The factor of every pixel follows from its depth; across the rim it falls from 1 to that of the scene 'dim'."""
    changed, paths, dim = scene("cloud"), scene("paths"), scene("dim")
    assert changed.frame(EVENT).images.tobytes() == paths.frame(EVENT).images.tobytes()
    for split in ("train", "test"):
        before, after, dark = (source.frame(19, split).images for source in (paths, changed, dim))
        cameras = paths.frame(19, split).cameras
        depth = paths.depth(19, split)
        for i in range(len(cameras)):
            x, y = np.meshgrid(np.arange(cameras.width) + 0.5, np.arange(cameras.height) + 0.5)
            rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(cameras.Ks[i]).T @ cameras.viewmats[i, :3, :3]
            across = cameras.centers[i][1] + rays[..., 1] * depth[i]
            left, right = across < -1, across > 1  # a pixel wide away from the rim
            assert left.sum() > 20
            assert right.sum() > 20
            assert np.array_equal(after[i][left], before[i][left])
            assert np.array_equal(after[i][right], dark[i][right])
            assert before[i][right].mean() - after[i][right].mean() > 1 / 255
            assert np.all(after[i] <= before[i])


def test_nothing_happens_where_nothing_moves_and_a_wrong_name_is_explained() -> None:
    for name in ("stop", "reversal", "bounce", "occlusion"):
        still = scene(name, static=1)
        assert still.frame(0).images.tobytes() == still.frame(19).images.tobytes(), name
    with pytest.raises(SourceError, match="option 'scene' = 'stops'"):
        scene("stops")
