"""The room that cameras stand in, and the sphere of seeds behind the scene."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import torch
from rigs import HEIGHT, WIDTH, in_line, inwards, looking, on_arc, outwards, parallel
from scipy.ndimage import map_coordinates, uniform_filter

from gsstream.core.cameras import Cameras
from gsstream.core.focus import focus_point
from gsstream.core.projection import inside, project
from gsstream.engine.run.encoder import one_torch_thread
from gsstream.input.seeds import room
from gsstream.input.seeds.fusion import world_points
from gsstream.input.seeds.geometry import spread_views
from gsstream.input.seeds.room import (
    MOST_CAMERAS,
    Room,
    find_room,
    room_depths,
    stands_around,
    with_room,
)
from gsstream.input.seeds.seeding import photo_consistent_seeds
from gsstream.input.seeds.shell import BEYOND, RADIUS, SEEDS, find_shell, in_shell, mean_color, shell_points
from gsstream.input.seeds.shell import WIDTH as OVERLAP
from gsstream.input.seeds.surface import ENOUGH, HALF, NOISE, Surface
from gsstream.input.seeds.window import window_mean

#: A little off what the cameras look at.
TRUTH = Room(np.array([0.05, -0.04, 0.02]), 3.3, np.array([0.0, 0.0, 1.0]), -0.7)
DOME = looking(on_arc(5, 300), [[0, 0, 0], [0.2, 0, 0], [0, -0.2, 0.1], [-0.1, 0.1, 0], [0, 0, 0.1]])


@pytest.fixture(autouse=True, scope="module")
def one_thread() -> Iterator[None]:
    """As an encoder works: the tensors are small, and two threads wait for each other on a busy machine."""
    with one_torch_thread():
        yield


def paint(points: np.ndarray) -> np.ndarray:
    """[P, 3] in [0, 1]: a smooth texture without two places alike, for points [P, 3]."""
    waves = np.random.default_rng(5).normal(size=(12, 3)) * 2.5
    phases = points @ waves.T
    return (0.5 + 0.5 * np.tanh(np.stack([np.sin(phases[:, i::3] + i).sum(1) for i in range(3)], 1) / 1.5)).astype("f4")


def photograph(room: Room, cameras: Cameras) -> np.ndarray:
    """[C, H, W, 3] what the cameras see of the walls of a room."""
    depths = room_depths(room, cameras)
    shown = [paint(world_points(depths, cameras, view)) for view in range(len(cameras))]
    return np.stack(shown).reshape(len(cameras), HEIGHT, WIDTH, 3)


@pytest.mark.parametrize(
    ("cameras", "around"),
    [
        (inwards(4, 360), True),
        (inwards(8, 360), True),
        (inwards(2, 180), True),
        (inwards(3, 130), True),
        (inwards(31, 180, radius=50), True),
        (DOME, True),
        (inwards(3, 100), True),
        (inwards(3, 80), False),
        (inwards(9, 68), False),
        (inwards(4, 30), False),
        (in_line(4), False),
        (outwards(6), False),
        (outwards(3), False),
        (parallel(5), False),
        (parallel(5, wobble=0.02), False),
        (looking([[1, 2, 3]], [[0, 0, 0]]), False),
        # One camera of a ring that looks away sees no room that the others stand in.
        (looking(on_arc(4, 360), [[0, 0, 0]] * 3 + [[0, -9, 0.6]]), False),
    ],
)
def test_a_rig_stands_around_when_some_pair_faces_each_other(cameras: Cameras, around: bool) -> None:
    assert stands_around(cameras) == around


def test_depth_ends_on_a_wall_that_nothing_is_before() -> None:
    depths = room_depths(TRUTH, DOME)
    on_wall = on_floor = 0
    for view, start in enumerate(DOME.centers):
        ends = world_points(depths, DOME, view)
        for end in ends[:: WIDTH * 3 + 7]:
            away, height = np.linalg.norm(end - TRUTH.middle) - TRUTH.radius, end @ TRUTH.up - TRUTH.floor
            assert min(abs(away), abs(height)) < 1e-9
            on_wall, on_floor = on_wall + (abs(away) < 1e-9), on_floor + (abs(height) < 1e-9)
            for share in (0.1, 0.5, 0.99):  # all before the end lies inside of the room
                way = start + share * (end - start)
                assert np.linalg.norm(way - TRUTH.middle) < TRUTH.radius
                assert way @ TRUTH.up > TRUTH.floor
    assert on_wall > 20
    assert on_floor > 20


def test_a_camera_outside_of_the_sphere_still_has_depths() -> None:
    depths = room_depths(TRUTH._replace(radius=1.0), DOME)
    assert np.isfinite(depths).all()
    assert (depths > 0).all()


@pytest.fixture(scope="module")
def found() -> Room:
    return find_room(photograph(TRUTH, DOME), DOME)


def test_the_room_is_found_from_its_pictures_and_again(found: Room) -> None:
    assert found.radius == pytest.approx(TRUTH.radius, rel=0.03)
    np.testing.assert_allclose(found.middle, TRUTH.middle, atol=0.15)
    np.testing.assert_allclose(found.up, TRUTH.up, atol=1e-9)
    assert found.floor == pytest.approx(TRUTH.floor, abs=0.05)
    again = find_room(photograph(TRUTH, DOME), DOME)
    assert [np.asarray(value).tobytes() for value in again] == [np.asarray(value).tobytes() for value in found]


#: A square of places of which the middle is the origin.
STEPS = np.linspace(-2, 2, 40)
FLAT = np.stack(np.meshgrid(STEPS, STEPS, [0.0], indexing="ij"), -1)[:, :, 0]
#: Places all around, as a globe has them.
HEIGHTS, TURNS = np.meshgrid(np.linspace(-1.5, 1.5, 30), np.linspace(0, 6.2, 70), indexing="ij")
ROUND = np.stack([np.cos(HEIGHTS) * np.cos(TURNS), np.cos(HEIGHTS) * np.sin(TURNS), np.sin(HEIGHTS)], -1)


def test_pictures_agree_on_the_true_surface_only() -> None:
    grey = torch.from_numpy(photograph(TRUTH, DOME).mean(-1))
    heights = (-1.1, -0.7, -0.3)
    scores = {z: Surface.shaped(grey, DOME, FLAT).agreement(np.array([0, 0, z])) for z in heights}
    assert scores[-0.7] > 0.8 > 2 * max(scores[-1.1], scores[-0.3])
    black = Surface.shaped(torch.zeros_like(grey), DOME, FLAT).agreement(np.zeros(3))
    assert black == 0, "black pictures agree on nothing"


#: Cameras that look level to all sides, and so past every place of a plane.
AWAY = outwards(16)


def looked_up(picture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """What a picture shows at pixels [N, 2] whose origin is a corner, in between linearly."""
    return map_coordinates(picture.astype(np.float64), [uv[:, 1] - 0.5, uv[:, 0] - 0.5], order=1, mode="nearest")


def agreement_of_whole_surfaces(grey: np.ndarray, cameras: Cameras, surface: np.ndarray) -> float:
    """What the agreement is by definition: every camera drawn on all of a surface, every pair compared on all of it."""

    def mean(values: np.ndarray) -> np.ndarray:
        return np.asarray(uniform_filter(values.astype(np.float64), 2 * HALF + 1, mode="nearest"))

    drawn = []
    for view in range(len(cameras)):
        uv, depth = project(surface.reshape(-1, 3), cameras, view)
        seen = inside(uv, depth, cameras) & (depth > cameras.near_plane)
        shade = np.where(seen, looked_up(grey[view], uv), 0).reshape(surface.shape[:2])
        spread = np.maximum(mean(shade**2) - mean(shade) ** 2, 0)
        drawn.append((shade, spread, (mean(seen.reshape(shade.shape)) > 0.99) & (spread > NOISE**2)))
    same = []
    for (one, its, here), (other, others, there) in combinations(drawn, 2):
        shared = (mean(one * other) - mean(one) * mean(other)) / np.sqrt((its + NOISE**2) * (others + NOISE**2))
        same.append(np.maximum(shared, 0)[here & there])
    all_of_them = np.concatenate(same)
    return float(all_of_them.mean() * min(1, len(all_of_them) / ENOUGH)) if len(all_of_them) else 0.0


@pytest.mark.parametrize("shape", [FLAT, ROUND], ids=["a plane", "a sphere"])
@pytest.mark.parametrize(
    "cameras",
    [DOME, inwards(6, 360), inwards(2, 180), AWAY, parallel(5), replace(DOME, near_plane=2.8)],
    ids=["dome", "ring", "two", "outwards", "side by side", "far near plane"],
)
def test_pictures_agree_as_by_definition_wherever_the_surface_lies(cameras: Cameras, shape: np.ndarray) -> None:
    grey = photograph(TRUTH, DOME).mean(-1)[np.arange(len(cameras)) % len(DOME)]
    surface = Surface.shaped(torch.from_numpy(grey), cameras, shape)
    all_found = []
    for shift, scale in (([0, 0, -0.7], 1.0), ([0.1, -0.3, 0.2], 3.3), ([0, 0, 0], 0.9), ([2.9, 0.5, 0], 1.4)):
        found = surface.agreement(np.array(shift), scale)
        expected = agreement_of_whole_surfaces(grey, cameras, np.array(shift) + scale * shape)
        assert found == pytest.approx(expected, rel=1e-3, abs=1e-5)
        all_found.append(found)
    assert (max(all_found) > 0.001) == (cameras is not AWAY or shape is not FLAT)


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(room, "find_room", lambda *_: TRUTH)


@pytest.mark.usefixtures("known")
def test_walls_stand_in_where_the_sweep_is_wrong_and_nobody_contradicts() -> None:
    images, truth = photograph(TRUTH, DOME), room_depths(TRUTH, DOME)
    wrong = np.full_like(truth, 0.4).astype("f4")  # right before the lenses, as chance matches are
    nowhere = np.zeros(truth.shape, bool)
    depths, kept = with_room(images, DOME, wrong, wrong, nowhere, nowhere)
    error = np.abs(depths - truth)[kept] / truth[kept]
    assert kept.mean() > 0.8
    assert error.max() < 1e-6
    # A camera that sees something else in place of the wall contradicts what others put there.
    other = images.copy()
    other[2] = 1 - other[2][::-1, ::-1]
    fewer = with_room(other, DOME, wrong, wrong, nowhere, nowhere)[1]
    assert fewer.mean() < kept.mean() - 0.1


@pytest.mark.usefixtures("known")
def test_what_the_sweep_is_sure_of_stays_unless_it_lies_behind_the_wall() -> None:
    images, truth = photograph(TRUTH, DOME), room_depths(TRUTH, DOME).astype("f4")
    swept = 0.6 * truth
    sure = np.zeros(truth.shape, bool)
    sure[:, ::2] = True
    nowhere = np.zeros(truth.shape, bool)
    depths, kept = with_room(images, DOME, swept, swept, sure, nowhere)
    np.testing.assert_array_equal(depths[sure], swept[sure])
    assert kept[sure].all()
    beyond, _ = with_room(images, DOME, 1.5 * truth, 1.5 * truth, sure, nowhere)
    assert np.median(beyond[sure] / truth[sure]) == pytest.approx(1), "nothing is seen through a wall"
    given = np.zeros(truth.shape, bool)
    given[:, :, ::3] = True
    mixed, chosen = with_room(images, DOME, swept, swept, sure, given)
    np.testing.assert_array_equal(mixed[given], swept[given])
    np.testing.assert_array_equal(chosen[given], sure[given])


def test_more_cameras_than_that_take_no_longer_to_find_the_room(monkeypatch: pytest.MonkeyPatch) -> None:
    cameras = inwards(20, 360)
    chosen = spread_views(cameras, MOST_CAMERAS)
    assert len(set(chosen.tolist())) == MOST_CAMERAS
    gaps = np.linalg.norm(cameras.centers[chosen][:, None] - cameras.centers[chosen], axis=2) + 9 * np.eye(MOST_CAMERAS)
    assert gaps.min() > 1.5 * 2 * 3 * np.sin(np.pi / 20), "no two of them are neighbours"
    assert spread_views(cameras, 50).tolist() == list(range(20))
    monkeypatch.setattr(room, "MOST_CAMERAS", 3)
    images, chosen = photograph(TRUTH, cameras), spread_views(cameras, 3)
    few = find_room(images[chosen], cameras.select(chosen.tolist()))
    many = find_room(images, cameras)
    assert all(np.array_equal(a, b) for a, b in zip(few, many, strict=True))


@pytest.mark.usefixtures("known")
def test_black_pictures_give_black_seeds() -> None:
    images = np.zeros((len(DOME), HEIGHT, WIDTH, 3), np.float32)
    points = photo_consistent_seeds(images, replace(DOME, near_plane=0.1), 100).points
    assert np.isfinite(points.xyz).all()
    assert (points.rgb == 0).all()


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
    assert in_shell(points.xyz, wide, shell).all()
    assert not in_shell(points.xyz, wide - 1, shell).any(), "small ones at the wall are part of the scene"
    middle = shell.center + 0.5 * (points.xyz - shell.center)
    assert not in_shell(middle, wide, shell).any(), "large ones amid the cameras are part of the scene"


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
