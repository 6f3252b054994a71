"""Rigs that differ in where their cameras stand and look."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from gsstream.core.cameras import Cameras

WIDTH, HEIGHT, FOCAL = 64, 48, 50.0


def looking(
    centers: ArrayLike,
    targets: ArrayLike,
    up: Sequence[float] = (0.0, 0.0, 1.0),
    K: ArrayLike | None = None,
    size: tuple[int, int] = (WIDTH, HEIGHT),
    near: float = 0.01,
    names: tuple[str, ...] | None = None,
) -> Cameras:
    """Cameras held level at these places, each looking at its target; one that looks along ``up`` has x to its right.

    It shares nothing with how the library places cameras.
    """
    centers = np.asarray(centers, np.float64).reshape(-1, 3)
    viewmats = np.tile(np.eye(4), (len(centers), 1, 1))
    for pose, center, target in zip(viewmats, centers, np.broadcast_to(targets, centers.shape), strict=True):
        forward = (target - center) / np.linalg.norm(target - center)
        right = np.cross(forward, up)
        right = right / np.linalg.norm(right) if np.linalg.norm(right) > 1e-6 else np.array([1.0, 0, 0])
        pose[:3, :3] = [right, np.cross(forward, right), forward]
        pose[:3, 3] = -pose[:3, :3] @ center
    Ks = np.asarray([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]] if K is None else K, np.float64)
    names = names or tuple(f"cam{i}" for i in range(len(centers)))
    return Cameras(names, viewmats, np.tile(Ks, (len(centers), 1, 1)), *size, near)


def on_arc(count: int, degrees: float, radius: float = 3.0, height: float = 0.6) -> list[list[float]]:
    """Places on an arc around the origin; with 360 degrees they are spread evenly."""
    angles = np.radians(degrees) * np.arange(count) / (count if degrees == 360 else count - 1)
    return [[radius * np.cos(a), radius * np.sin(a), height] for a in angles]


def inwards(count: int, degrees: float, radius: float = 3.0) -> Cameras:
    places = on_arc(count, degrees, radius)
    return looking(places, [[0, 0, 0]] * count)


def outwards(count: int) -> Cameras:
    places = np.array(on_arc(count, 360, radius=0.3))
    return looking(places.tolist(), (10 * places).tolist())


def parallel(count: int, wobble: float = 0.0) -> Cameras:
    """Cameras side by side that look along y, turned by up to ``wobble`` radians."""
    places = [[0.2 * i, 0.0, 0.0] for i in range(count)]
    turns = np.random.default_rng(3).uniform(-wobble, wobble, count)
    targets = [[x + 10 * np.sin(a), 10 * np.cos(a), 0] for (x, _, _), a in zip(places, turns, strict=True)]
    return looking(places, targets)


def in_line(count: int) -> Cameras:
    """Cameras one behind the other, all of which look at one place."""
    return looking([[-1.0 - 0.5 * i, 0.0, 0.1] for i in range(count)], [[2, 0, 0]] * count)
