"""A camera path from a JSON file: poses that the player follows, or runs between.

::

    {"width": 640, "height": 360, "K": [[600, 0, 320], [0, 600, 180], [0, 0, 1]],
     "cameras": [{"w2c": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]}, ...]}

``w2c`` and ``K`` are those of cameras.json: world to camera in the recording's coordinates, OpenCV axes, pixels. ``K``
may stand in a camera, too. Without width, height and K the cameras are those of the stream. With as many cameras as
pictures each shows one; otherwise the path runs evenly from the first to the last.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.errors import InputError, ShapeError
from gsstream.core.shapes import FloatArray
from gsstream.core.world import IDENTITY, World

_MOST = 1_000_000


def read_path(path: Path, rig: Cameras, number: int, world: World = IDENTITY) -> Cameras:
    """Return ``number`` cameras along the path of a file.

    Raises InputError naming file and camera for anything that is not such a path.
    """
    data = _load(path)
    size = _size(path, data, rig)
    entries = data["cameras"]
    poses = np.stack([_matrix(path, f"camera {i}: w2c", entry.get("w2c"), 4) for i, entry in enumerate(entries)])
    default = data.get("K")
    scaled = rig.select([0]).scaled(*size)
    Ks = np.stack(
        [
            scaled.Ks[0] if (K := entry.get("K", default)) is None else _matrix(path, f"camera {i}: K", K, 3)
            for i, entry in enumerate(entries)
        ]
    )
    named = replace(scaled, ids=tuple(f"file-{i:04d}" for i in range(len(entries))), viewmats=poses, Ks=Ks)
    try:
        named.validate()
    except ShapeError as error:
        raise InputError(f"{path}: {error}") from error
    placed = replace(world.inverse_cameras(named), near_plane=rig.near_plane)
    return placed if len(placed) == number else _between(placed, number)


def _load(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: cannot be read as a camera path: {error}") from error
    cameras = data.get("cameras") if isinstance(data, dict) else None
    if not isinstance(cameras, list) or not all(isinstance(c, dict) for c in cameras) or not 0 < len(cameras) < _MOST:
        raise InputError(f'{path}: expected a list "cameras" of objects with a "w2c", world to camera, 4 x 4')
    known: dict[str, Any] = data
    return known


def _size(path: Path, data: dict[str, Any], rig: Cameras) -> tuple[int, int]:
    size = data.get("width", rig.width), data.get("height", rig.height)
    if not all(type(side) is int and 1 <= side <= 1 << 16 for side in size):
        raise InputError(f"{path}: width and height must be 1 to 65536 pixels, got {size[0]!r} x {size[1]!r}")
    return size


def _matrix(path: Path, what: str, value: Any, side: int) -> FloatArray:
    try:
        matrix = np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: {what} is not a matrix of numbers ({error})") from error
    if matrix.shape != (side, side):
        raise InputError(f"{path}: {what} must be {side} x {side}, got shape {list(matrix.shape)}")
    return matrix


def _between(rig: Cameras, number: int) -> Cameras:
    """``number`` cameras from the first to the last: positions and intrinsics linearly, rotations on the sphere."""
    at = np.linspace(0, len(rig) - 1, number)
    low = np.minimum(at.astype(np.int64), max(0, len(rig) - 2))
    high = np.minimum(low + 1, len(rig) - 1)
    share = (at - low)[:, None]
    centers = (1 - share) * rig.centers[low] + share * rig.centers[high]
    Ks = (1 - share[..., None]) * rig.Ks[low] + share[..., None] * rig.Ks[high]
    viewmats = np.tile(np.eye(4), (number, 1, 1))
    for i in range(number):
        first, last = rig.viewmats[low[i], :3, :3], rig.viewmats[high[i], :3, :3]
        viewmats[i, :3, :3] = _turned(last @ first.T, float(share[i, 0])) @ first
        viewmats[i, :3, 3] = -viewmats[i, :3, :3] @ centers[i]
    return replace(rig, ids=tuple(f"file-{i:04d}" for i in range(number)), viewmats=viewmats, Ks=Ks)


def _turned(rotation: FloatArray, share: float) -> FloatArray:
    """[3, 3] a share of a rotation about its own axis."""
    angle = float(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1)))
    axis = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    if angle > np.pi - 1e-4:
        # Half a turn: the antisymmetric part vanishes, and the axis stands in the symmetric one, up to its sign.
        outer = (rotation + np.eye(3)) / 2
        axis = outer[int(np.argmax(np.diag(outer)))]
    norm = float(np.linalg.norm(axis))
    if angle < 1e-9 or norm < 1e-12:
        return np.eye(3)
    x, y, z = axis / norm
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    part: FloatArray = np.eye(3) + np.sin(share * angle) * cross + (1 - np.cos(share * angle)) * cross @ cross
    return part
