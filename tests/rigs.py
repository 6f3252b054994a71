"""Rigs that differ in where their cameras stand and look."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsstream.core.cameras import Cameras

WIDTH, HEIGHT, FOCAL = 64, 48, 50.0


def looking(centers: Sequence[Sequence[float]], targets: Sequence[Sequence[float]]) -> Cameras:
    """Cameras held level (z is up) at these places, each looking at its target."""
    viewmats = np.tile(np.eye(4), (len(centers), 1, 1))
    for pose, center, target in zip(viewmats, np.array(centers, float), np.array(targets, float), strict=True):
        forward = (target - center) / np.linalg.norm(target - center)
        right = np.cross(forward, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        pose[:3, :3] = [right, np.cross(forward, right), forward]
        pose[:3, 3] = -pose[:3, :3] @ center
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    names = tuple(f"cam{i}" for i in range(len(centers)))
    return Cameras(names, viewmats, np.tile(K, (len(centers), 1, 1)), WIDTH, HEIGHT)


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
