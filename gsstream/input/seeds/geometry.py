"""Where a rig looks, which of its cameras match well, and which of them see a point. Training cameras only."""

from __future__ import annotations

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.focus import focus_point
from gsstream.core.projection import inside, project
from gsstream.core.shapes import BoolArray, FloatArray, IntArray


def visible_views(points: FloatArray, cameras: Cameras) -> BoolArray:
    """Return [P, C] bool: which cameras have a point inside their image and in front of them.

    Occlusion is not considered.

    Returns [P, C] bool.
    """
    visible = np.zeros((len(points), len(cameras)), bool)
    for index in range(len(cameras)):
        uv, depth = project(points, cameras, index)
        visible[:, index] = inside(uv, depth, cameras)
    return visible


def pixel_centers(width: int, height: int) -> FloatArray:
    """Return [height * width, 2] centres of all pixels, row by row."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([x.ravel(), y.ravel()], axis=1)


def spread_views(cameras: Cameras, count: int) -> IntArray:
    """Return [min(count, C)], ascending: cameras that stand far apart, the first of them farthest from the middle."""
    gaps = np.linalg.norm(cameras.centers[:, None] - cameras.centers[None], axis=2)
    chosen = [int(np.linalg.norm(cameras.centers - cameras.centers.mean(0), axis=1).argmax())]
    while len(chosen) < min(count, len(cameras)):
        nearest = gaps[:, chosen].min(1)
        nearest[chosen] = -1
        chosen.append(int(nearest.argmax()))
    return np.sort(np.array(chosen))


def depth_range(cameras: Cameras, near: float = 0.3, far: float = 4.0) -> FloatArray:
    """Return [C, 2]: nearest and farthest planar depth worth searching, scene units."""
    centers = cameras.centers
    gaps = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    distance = np.linalg.norm(centers - focus_point(cameras), axis=1)
    # Cameras that look outwards have the focus among them; then the size of the rig is taken as the distance.
    distance = np.maximum(distance, max(float(gaps.max()), 1e-6) * 0.25)
    return np.stack([near * distance, np.maximum(far * distance, 1.3 * gaps.max(1))], axis=1)


def neighbour_views(cameras: Cameras, count: int, least_angle: float = 5.0) -> IntArray:
    """Return [C, min(count, C - 1)]: best partners of each camera for matching.

    They are nearest in direction seen from the focus.

    Angles under ``least_angle`` degrees give poor depth and are put back in the order.
    """
    outward = cameras.centers - focus_point(cameras)
    outward = outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-12)
    angle = np.degrees(np.arccos(np.clip(outward @ outward.T, -1, 1)))
    rank = np.where(angle < least_angle, least_angle + 4 * (least_angle - angle), angle)
    np.fill_diagonal(rank, np.inf)
    return np.argsort(rank, axis=1, kind="stable")[:, : min(count, len(cameras) - 1)]
