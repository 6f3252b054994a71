"""Scenes for benchmarks: made from a seed; statistics like those of trained scenes.

Like a trained scene: anisotropic with one thin axis, log-normal scales around the distance to the neighbours, a few
large ones, opacities either faint or nearly opaque, rows in Morton order (memory order follows space). What differs
from a real scene: orientations are random, so surfaces are rougher and a pixel needs more Gaussians to become opaque.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.gaussians import SH0, Gaussians
from gsstream.core.rng import Rng
from gsstream.core.shapes import FloatArray, IntArray

#: Where the object stands that the frame benchmark moves; no static point lies within OBJECT_ROOM of its centre.
OBJECT_CENTER = (0.0, 0.0, 0.0)
OBJECT_RADIUS, OBJECT_ROOM = 0.25, 0.35
_MORTON_BITS = 10
_NEIGHBOURS = 8


@dataclass(frozen=True, slots=True)
class Points:
    """``xyz`` [P, 3], ``rgb`` [P, 3] in [0, 1]."""

    xyz: FloatArray
    rgb: FloatArray


def synthetic_points(count: int, seed: int) -> Points:
    """Return points on the walls of a room, on a dozen bodies beside and behind the object, and on a far shell."""
    rng = Rng(seed).numpy("bench points")
    centers = rng.uniform([-2.2, -1.3, -0.2], [2.2, 1.3, 2.6], (12, 3))
    centers[np.linalg.norm(centers, axis=1) < 1] *= [2, 1, 1]
    sizes, phase = rng.uniform(0.1, 0.5, (12, 3)), rng.uniform(0, 6, 3)
    kind = rng.choice(3, count, p=[0.35, 0.55, 0.1])
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    walls = directions / np.abs(directions).max(1, keepdims=True) * [3.0, 1.6, 3.0]
    body = rng.integers(0, len(centers), count)
    bodies, shell = centers[body] + directions * sizes[body], directions * 12.0
    xyz = np.choose(kind[:, None], [walls, bodies, shell])
    crowded = np.linalg.norm(xyz - OBJECT_CENTER, axis=1) < OBJECT_ROOM
    xyz[crowded] = shell[crowded]
    rgb = 0.5 + 0.45 * np.sin(3.0 * xyz + phase) * rng.uniform(0.5, 1.0, (count, 1))
    return Points(xyz, rgb)


def object_points(count: int, seed: int) -> Points:
    """Return points on the body that moves: a ball of radius OBJECT_RADIUS with a bold texture."""
    directions = Rng(seed).numpy("bench object").normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    rgb = 0.5 + 0.45 * np.sign(np.sin(9.0 * directions))
    return Points(directions * OBJECT_RADIUS + OBJECT_CENTER, rgb)


def make_gaussians(points: Points, seed: int, *, degree: int = 2) -> Gaussians[FloatArray]:
    """Return a Gaussian at each of these points, float32."""
    count = len(points.xyz)
    rng = Rng(seed).numpy("bench gaussians", count)
    chosen = rng.permutation(count)
    xyz, rgb = points.xyz[chosen], points.rgb[chosen]
    order = morton_order(xyz)
    xyz, rgb = xyz[order], rgb[order]
    spacing = neighbour_spacing(xyz)
    widths = spacing[:, None] * np.exp(rng.normal(size=(count, 3)) * 0.6) * 0.7
    widths[np.arange(count), rng.integers(0, 3, count)] *= 0.2
    widths[rng.random(count) < 0.02] *= 4
    faint = rng.random(count) < 0.5
    opacities = np.where(faint, rng.normal(-1.5, 1.2, count), rng.normal(2.5, 1.5, count))
    shN = rng.normal(size=(count, (degree + 1) ** 2 - 1, 3)) * 0.05
    arrays = (xyz, rng.normal(size=(count, 4)), np.log(widths), opacities, ((rgb - 0.5) / SH0)[:, None], shN)
    return Gaussians(*(np.ascontiguousarray(array, np.float32) for array in arrays))


def morton_order(xyz: FloatArray) -> IntArray:
    """Return the permutation that sorts points along a Z curve of 10 bits an axis."""
    low = xyz.min(0)
    cells = ((xyz - low) / max(1e-12, float((xyz.max(0) - low).max())) * (2**_MORTON_BITS - 1)).astype(np.int64)
    keys = np.zeros(len(xyz), np.int64)
    for bit in range(_MORTON_BITS):
        for axis in range(3):
            keys |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(keys, kind="stable")


def neighbour_spacing(xyz: FloatArray) -> FloatArray:
    """Return [P]: mean distance to the three nearest among the rows around each, without outliers.

    Points must be in Morton order.
    """
    count = len(xyz)
    reach = [k for k in range(-_NEIGHBOURS, _NEIGHBOURS + 1) if k]
    around = (np.arange(count)[:, None] + reach).clip(0, count - 1)
    distances = np.linalg.norm(xyz[around] - xyz[:, None], axis=2)
    distances[around == np.arange(count)[:, None]] = np.inf
    nearest = np.sort(distances, axis=1)[:, : min(3, count - 1)].mean(1)
    spacing: FloatArray = nearest.clip(1e-4, max(1e-4, float(np.quantile(nearest, 0.99))))
    return spacing


def arc_rig(views: int, width: int, height: int) -> Cameras:
    """Return ``views`` cameras on an arc of 60 degrees that look at the object.

    They are 2.4 units away and 60 degrees wide.
    """
    angles = np.deg2rad(np.linspace(-30, 30, views)) if views > 1 else np.zeros(1)
    viewmats = np.tile(np.eye(4), (views, 1, 1))
    for viewmat, angle in zip(viewmats, angles, strict=True):
        viewmat[0, [0, 2]] = np.cos(angle), np.sin(angle)
        viewmat[2, [0, 2]] = -np.sin(angle), np.cos(angle)
        viewmat[:3, 3] = (0, 0, 2.4) - viewmat[:3, :3] @ np.asarray(OBJECT_CENTER)
    focal = 0.5 * width / np.tan(np.deg2rad(30))
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Cameras(
        ids=tuple(f"bench{i}" for i in range(views)),
        viewmats=viewmats,
        Ks=np.tile(K, (views, 1, 1)),
        width=width,
        height=height,
    )
