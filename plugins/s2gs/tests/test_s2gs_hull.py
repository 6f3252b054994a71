"""Points where cameras agree that something is missing, against balls put in known places."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from gsstream_s2gs.hull import Hull, hull_points, one_per_cell

from gsstream.testing import images, rig, scene

VIEWS = 5
SETTINGS = {"rays": 64, "votes": 0.75, "least_views": 4, "agreement": 0.2}
BALLS = torch.tensor([[0.3, 0.1, 0.2], [-0.4, -0.2, 0.0]])


def found(balls: torch.Tensor = BALLS, mask_views: tuple[int, ...] = tuple(range(VIEWS)), **changes: float) -> Hull:
    """The hull of what the balls cover in black images."""
    cameras = rig(VIEWS)
    pictures = np.stack([image.numpy() for image in images(scene(balls), cameras)])
    masks = pictures.max(-1) > 0.1
    for view in set(range(VIEWS)) - set(mask_views):
        masks[view] = False
    generator = np.random.default_rng(0)
    return hull_points(pictures, masks, cameras, (1.0, 6.0), generator=generator, **{**SETTINGS, **changes})


@pytest.mark.parametrize("ball", [0, 1])
def test_a_ball_is_found_where_it_is(ball: int) -> None:
    hull = found(BALLS[ball : ball + 1])
    distance = np.linalg.norm(hull.xyz - BALLS[ball].numpy(), axis=-1)
    # Five cameras on a short arc leave some freedom in depth.
    assert float(np.median(distance)) < 0.3
    assert float(distance.max()) < 1.0


def test_of_two_balls_both_are_found() -> None:
    hull = found()
    distance = np.linalg.norm(hull.xyz[:, None] - BALLS.numpy(), axis=-1)
    assert bool((distance.min(0) < 0.15).all())
    assert hull.xyz.dtype == hull.rgb.dtype == hull.size.dtype == np.float32


def test_the_size_is_that_of_a_pixel() -> None:
    """f = 25 pixels at distance 3: a pixel is 0.12 wide there."""
    hull = found(torch.zeros(1, 3))
    nearest = int(np.linalg.norm(hull.xyz, axis=1).argmin())
    assert float(hull.size[nearest]) == pytest.approx(3 / 25, rel=0.1)


@pytest.mark.parametrize("views", [(), (0,), (0, 1, 2)])
def test_too_few_witnesses_find_nothing(views: tuple[int, ...]) -> None:
    assert len(found(mask_views=views)) == 0


def test_a_hole_in_one_of_five_views_is_forgiven_by_the_votes() -> None:
    assert len(found(mask_views=(0, 1, 2, 3))) > 0
    assert len(found(mask_views=(0, 1, 2, 3), votes=1.0)) == 0


def test_colours_that_disagree_are_no_surface() -> None:
    cameras = rig(VIEWS)
    pictures = np.stack([np.full((cameras.height, cameras.width, 3), v / 4, np.float32) for v in range(VIEWS)])
    masks = np.ones(pictures.shape[:3], bool)
    generator = np.random.default_rng(0)
    strict = hull_points(pictures, masks, cameras, (1.0, 6.0), generator=generator, **SETTINGS)
    assert len(strict) == 0
    loose = hull_points(pictures, masks, cameras, (1.0, 6.0), generator=generator, **{**SETTINGS, "agreement": 0.4})
    assert len(loose) > 0
    assert np.allclose(loose.rgb, 0.5, atol=0.13)


def test_one_per_cell_keeps_the_first_of_each() -> None:
    xyz = np.array([[0.1, 0, 0], [0.2, 0, 0], [-0.1, 0, 0], [1.2, 0, 0]], np.float32)
    hull = Hull(xyz, np.zeros((4, 3), np.float32), np.arange(4, dtype=np.float32))
    assert one_per_cell(hull, 1.0, 10).size.tolist() == [0, 2, 3]
    assert one_per_cell(hull, 1.0, 2).size.tolist() == [0, 2]
    empty = Hull(xyz[:0], xyz[:0], np.zeros(0, np.float32))
    assert len(one_per_cell(empty, 1.0, 2)) == 0


def test_no_cameras() -> None:
    none = hull_points(
        np.zeros((0, 4, 4, 3), np.float32), np.zeros((0, 4, 4), bool), rig(VIEWS).select([]), (1.0, 2.0),
        generator=np.random.default_rng(0), **SETTINGS,
    )  # fmt: skip
    assert len(none) == 0
