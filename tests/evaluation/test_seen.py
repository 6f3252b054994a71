"""Pixels whose surface training cameras see, against a ray cast of the same two rectangles."""

from __future__ import annotations

import math

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import BoolArray, FloatArray
from gsstream.evaluation.seen import draw_depths, seen_masks

WIDTH, HEIGHT, FOCAL = 96, 72, 80.0
#: Rectangles across the z axis: depth, and half sides.
WALL, BOARD = (4.0, 6.0, 5.0), (2.5, 0.6, 0.5)


def rig(*places: float) -> Cameras:
    """Cameras on the x axis that look along z."""
    viewmats = np.repeat(np.eye(4)[None], len(places), 0)
    viewmats[:, 0, 3] = -np.array(places)
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1.0]])
    names = tuple(f"at {place}" for place in places)
    return Cameras(names, viewmats, np.repeat(K[None], len(places), 0), WIDTH, HEIGHT)


def rectangles() -> Gaussians[FloatArray]:
    """Both as flat opaque Gaussians, closer together than they are wide."""
    means, widths = [], []
    for (z, x_side, y_side), spacing in ((WALL, 0.05), (BOARD, 0.02)):
        x, y = np.meshgrid(np.arange(-x_side, x_side, spacing), np.arange(-y_side, y_side, spacing))
        means.append(np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)]))
        widths.append(np.full(x.size, 0.8 * spacing))
    at = np.concatenate(means).astype(np.float32)
    count, sides = len(at), np.log(np.concatenate(widths))
    scales = np.column_stack([sides, sides, np.full(count, math.log(1e-3))]).astype(np.float32)
    return Gaussians(
        means=at,
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        scales=scales,
        opacities=np.full(count, 4.0, np.float32),
        sh0=np.zeros((count, 1, 3), np.float32),
        shN=np.zeros((count, 0, 3), np.float32),
    )


def cast(origin: FloatArray, directions: FloatArray) -> FloatArray:
    """[...] distance along z of the nearest rectangle that rays with dz = 1 meet; inf for none."""
    nearest = np.full(directions.shape[:-1], np.inf)
    for z, x_side, y_side in (WALL, BOARD):
        hit = origin + directions * z
        inside = (np.abs(hit[..., 0]) <= x_side) & (np.abs(hit[..., 1]) <= y_side)
        nearest = np.where(inside & (z < nearest), z, nearest)
    return nearest


def expected(place: float, training: tuple[float, ...]) -> tuple[FloatArray, BoolArray]:
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    rays = np.stack([(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, np.ones_like(u)], -1)
    here = np.array([place, 0, 0])
    depth = cast(here, rays)
    points = here + rays * np.where(np.isfinite(depth), depth, 1)[..., None]
    count = np.zeros(depth.shape, int)
    for other in training:
        there = np.array([other, 0, 0])
        way = points - there
        way = way / way[..., 2:]
        inside = (np.abs(way[..., 0]) < WIDTH / 2 / FOCAL) & (np.abs(way[..., 1]) < HEIGHT / 2 / FOCAL)
        count += inside & (np.abs(cast(there, way) - points[..., 2]) < 0.01)
    return depth, np.isfinite(depth) & (count >= 2)


def test_depth_and_seen_pixels_are_those_of_a_ray_cast() -> None:
    scene, training, place = rectangles(), (-1.4, -0.9, 0.3), 0.8
    depth, seen = expected(place, training)
    drawn = draw_depths(scene, rig(place), 0)
    assert np.isfinite(drawn).all()
    assert np.mean(np.abs(drawn - depth) < 0.01 * depth) > 0.95
    (mask,) = seen_masks(scene, rig(*training), rig(place))
    # The board hides a part of the wall, and the right of the picture lies beyond what two cameras look at.
    assert 0.3 < seen.mean() < 0.8
    assert np.mean(mask == seen) > 0.95


def test_one_camera_does_not_say_where_a_surface_is_and_nothing_is_seen_where_nothing_is() -> None:
    scene = rectangles()
    assert not seen_masks(scene, rig(0.0), rig(0.1))[0].any()
    assert seen_masks(scene, rig(0.0, 0.2), rig(0.1))[0].mean() > 0.9
    scene.opacities[:] = -7
    assert not seen_masks(scene, rig(0.0, 0.2), rig(0.1))[0].any()
