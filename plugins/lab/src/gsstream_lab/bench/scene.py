"""Scenes for benchmarks: made from a seed, or from a file of points; statistics like those of trained scenes.

Like a trained scene: anisotropic with one thin axis, log-normal scales around the distance to the neighbours, a few
large ones, opacities either faint or nearly opaque, rows in Morton order (memory order follows space). Not like one:
orientations are random, so surfaces are rougher and a pixel needs more Gaussians to become opaque.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.errors import InputError
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
    """``xyz`` [P, 3], ``rgb`` [P, 3] in [0, 1], and the camera that came with them: viewmat [4, 4] and K [3, 3]."""

    xyz: FloatArray
    rgb: FloatArray
    viewmat: FloatArray | None = None
    K: FloatArray | None = None


def synthetic_points(count: int, seed: int) -> Points:
    """Return points on the walls of a room, on a dozen bodies in it, and on a far shell.

    Surfaces depend on the seed alone.

    The bodies stand beside and behind the object, so that the cameras of :func:`arc_rig` see it.
    """
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


def read_points(path: Path) -> Points:
    """Read a .npz of points.

    It holds ``xyz`` or ``means3d`` [P, 3], ``rgb`` or ``colors`` [P, 3] (uint8 or [0, 1]), and optionally ``viewmats``
    [C, 4, 4] and ``Ks`` [C, 3, 3], of which the first camera is used.

    Raises InputError naming the file and what it lacks.
    """
    try:
        with np.load(path) as data:
            arrays = {name: data[name] for name in data.files}
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read points from {path}: {error}; expected a .npz file") from error
    xyz, rgb = arrays.get("xyz", arrays.get("means3d")), arrays.get("rgb", arrays.get("colors"))
    if xyz is None or rgb is None or xyz.shape != rgb.shape or xyz.ndim != 2 or xyz.shape[1] != 3 or len(xyz) < 2:
        shapes = {name: list(value.shape) for name, value in arrays.items()}
        raise InputError(f"{path}: expected xyz and rgb (or means3d and colors), both [P, 3] with P > 1, got {shapes}")
    rgb = rgb / 255.0 if rgb.dtype == np.uint8 else rgb
    poses, intrinsics = arrays.get("viewmats"), arrays.get("Ks")
    if poses is None or intrinsics is None:
        return Points(np.asarray(xyz, np.float64), np.asarray(rgb, np.float64))
    return Points(np.asarray(xyz, np.float64), np.asarray(rgb, np.float64), poses[0], intrinsics[0])


def make_gaussians(points: Points, count: int, seed: int, *, degree: int = 2) -> Gaussians[FloatArray]:
    """Return ``count`` Gaussians at these points, float32: drawn from them without replacement, then near them."""
    rng = Rng(seed).numpy("bench gaussians", count)
    have = len(points.xyz)
    chosen = rng.permutation(have)[: min(have, count)]
    extra = rng.integers(0, have, max(0, count - have))
    xyz, rgb = points.xyz[chosen], points.rgb[chosen]
    order = morton_order(xyz)
    spacing = neighbour_spacing(xyz[order])
    if len(extra):
        near = rng.integers(0, len(order), len(extra))
        more = xyz[order][near] + rng.normal(size=(len(extra), 3)) * 0.7 * spacing[near, None]
        xyz, rgb = np.concatenate([xyz, more]), np.concatenate([rgb, rgb[order][near]])
        order = morton_order(xyz)
        spacing = neighbour_spacing(xyz[order])
    xyz, rgb = xyz[order], rgb[order]
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


def bench_camera(width: int, height: int, points: Points | None = None) -> Cameras:
    """Return one camera that sees about half of the scene.

    It is the points' own, scaled to cover the image, or one in the room.
    """
    if points is not None and points.viewmat is not None and points.K is not None:
        old_width, old_height = 2 * points.K[0, 2], 2 * points.K[1, 2]
        scale = max(width / old_width, height / old_height)
        K = np.diag([scale, scale, 1.0]) @ np.asarray(points.K, np.float64)
        K[0, 2], K[1, 2], K[0, 1] = width / 2, height / 2, 0.0
        return Cameras(("bench",), np.asarray(points.viewmat, np.float64)[None], K[None], width, height)
    return arc_rig(1, width, height)


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
    return Cameras(tuple(f"bench{i}" for i in range(views)), viewmats, np.tile(K, (views, 1, 1)), width, height)
