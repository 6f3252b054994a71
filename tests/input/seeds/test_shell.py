"""The sphere of seeds behind the scene, and means over windows of pictures."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from rigs import HEIGHT, WIDTH, in_line, inwards, looking, outwards, parallel
from scipy.ndimage import uniform_filter

from gsstream.core.cameras import Cameras
from gsstream.core.projection import project
from gsstream.input.seeds.geometry import focus_point
from gsstream.input.seeds.shell import BEYOND, RADIUS, SEEDS, find_shell, in_shell, mean_color, shell_points
from gsstream.input.seeds.shell import WIDTH as OVERLAP
from gsstream.input.seeds.window import window_mean

RIGS = {
    "a ring": inwards(6, 360), "an arc": inwards(5, 60), "two face to face": inwards(2, 180),
    "one behind another": in_line(4), "side by side": parallel(5), "mounted by hand": parallel(5, wobble=0.01),
    "outwards": outwards(6), "one camera": looking([[1, 2, 3]], [[0, 0, 0]]),
}  # fmt: skip


def pictures(cameras: Cameras) -> np.ndarray:
    rng = np.random.default_rng(1)
    return rng.random((len(cameras), HEIGHT, WIDTH, 3)).astype(np.float32)


@pytest.mark.parametrize("name", RIGS)
def test_the_shell_lies_around_every_camera_and_beyond_its_near_plane(name: str) -> None:
    cameras = RIGS[name]
    shell, points = find_shell(cameras), shell_points(pictures(cameras), cameras)
    assert len(points) == SEEDS
    away = np.linalg.norm(points.xyz - shell.center, axis=1)
    np.testing.assert_allclose(away, shell.radius, rtol=1e-5)
    if name != "one behind another":  # the last of those may stand a little farther out
        assert np.linalg.norm(cameras.centers - shell.center, axis=1).max() < BEYOND * shell.radius
    gaps = np.linalg.norm(points.xyz[:, None] - cameras.centers, axis=2)
    assert gaps.min() > max(cameras.near_plane, 0.3 * shell.radius), "no seed hangs before a lens"
    assert ((points.rgb >= 0) & (points.rgb <= 1)).all()
    # Nearly even: neighbours are as far apart as the width of a seed says.
    between = np.linalg.norm(points.xyz[:, None] - points.xyz[None], axis=2) + 1e9 * np.eye(SEEDS)
    assert np.median(between.min(1)) == pytest.approx(shell.sigma / OVERLAP, rel=0.2)


def test_what_cameras_look_at_is_the_middle() -> None:
    for name in ("a ring", "an arc", "two face to face"):
        cameras = RIGS[name]
        found = find_shell(cameras)
        np.testing.assert_allclose(found.center, focus_point(cameras), atol=1e-9)
        assert found.radius == pytest.approx(RADIUS * np.hypot(3, 0.6), rel=0.01)
    # Axes that are all but parallel meet right before the lenses, which is no place for a wall.
    by_hand, by_ruler = (find_shell(RIGS[name]).radius for name in ("mounted by hand", "side by side"))
    assert by_hand == pytest.approx(by_ruler, rel=0.01)


def test_a_seed_has_the_median_colour_of_the_views_that_see_it() -> None:
    cameras = inwards(5, 60)
    shades = np.array([0.1, 0.9, 0.3, 0.5, 0.2], np.float32)
    images = np.ones((5, HEIGHT, WIDTH, 3), np.float32) * shades[:, None, None, None]
    points = shell_points(images, cameras)
    seen_once = False
    for xyz, rgb in zip(points.xyz.astype(np.float64), points.rgb, strict=True):
        seen = []
        for view in range(5):
            (uv,), (depth,) = project(xyz[None], cameras, view)
            if depth > 0 and 0 <= uv[0] < WIDTH and 0 <= uv[1] < HEIGHT:
                seen.append(float(shades[view]))
        np.testing.assert_allclose(rgb, np.median(seen) if seen else shades.mean(), atol=1e-6)
        seen_once |= bool(seen)
    assert seen_once
    assert (shell_points(np.zeros_like(images), cameras).rgb == 0).all(), "black pictures, black walls"


@pytest.mark.parametrize("name", RIGS)
def test_seeds_belong_to_the_shell_and_the_scene_does_not(name: str) -> None:
    cameras = RIGS[name]
    shell, points = find_shell(cameras), shell_points(pictures(cameras), cameras)
    wide = np.full((SEEDS, 3), np.log(shell.sigma))
    assert in_shell(points.xyz, wide, cameras).all()
    assert not in_shell(points.xyz, wide - 1, cameras).any(), "small ones at the wall are part of the scene"
    middle = shell.center + 0.5 * (points.xyz - shell.center)
    assert not in_shell(middle, wide, cameras).any(), "large ones amid the cameras are part of the scene"


def test_the_mean_colour_is_that_of_all_pixels() -> None:
    images = np.zeros((2, 3, 4, 3), np.float32)
    images[0, ..., 0], images[1, 0, 0, 2] = 1, 0.5
    assert mean_color(images) == pytest.approx((0.5, 0, 0.5 / 24))
    assert mean_color(np.full((1, 2, 2, 3), 1 + 1e-5, np.float32)) == (1, 1, 1), "rounding does not leave [0, 1]"


@pytest.mark.parametrize("half", [0, 1, 2, 3, 6, 7, 11])
@pytest.mark.parametrize("shape", [(3, 1, 17, 23), (1, 1, 1, 5), (2, 1, 4, 1)])
def test_it_is_the_mean_of_another_implementation(half: int, shape: tuple[int, ...]) -> None:
    images = torch.rand(shape, generator=torch.Generator().manual_seed(half))
    expected = [uniform_filter(image[0].numpy().astype(np.float64), 2 * half + 1, mode="nearest") for image in images]
    np.testing.assert_allclose(window_mean(images, half)[:, 0].numpy(), np.stack(expected), rtol=2e-6, atol=1e-7)


def test_an_image_of_one_colour_stays_so() -> None:
    images = torch.full((1, 1, 9, 8), 0.3)
    torch.testing.assert_close(window_mean(images, 6), images, rtol=1e-6, atol=0)
    assert torch.equal(images, torch.full((1, 1, 9, 8), 0.3))  # what was given is not written to


def test_windows_do_not_write_to_what_they_were_given() -> None:
    images = torch.rand(2, 1, 12, 12, generator=torch.Generator().manual_seed(1))
    before = images.clone()
    for half in (0, 2, 6):
        window_mean(images, half)
    assert torch.equal(images, before)
