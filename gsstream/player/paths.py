"""Camera paths computed from a calibrated rig: around what it looks at, a spiral around its middle; other sizes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.errors import ShapeError
from gsstream.core.shapes import FloatArray
from gsstream.core.world import up_direction

PATHS = ("orbit", "spiral")
#: A rig with a larger gap than this between neighbouring cameras does not surround what it looks at, radians.
OPEN_GAP = np.pi / 2
#: Half of the smallest swing, radians: a single camera, or a few side by side, still show some parallax.
MIN_SWING = np.pi / 18


def camera_path(kind: str, rig: Cameras, number: int) -> Cameras:
    """Return ``number`` cameras along the path ``kind`` (one of PATHS), with the intrinsics of the rig's first.

    Arguments:
        kind: a name of PATHS.
        rig: cameras of the stream.
        number: of cameras, at least 1.
    """
    if kind not in PATHS:
        raise ShapeError(f"no camera path {kind!r}; known: {', '.join(PATHS)}")
    if len(rig) == 0 or number < 1:
        raise ShapeError(f"a path needs a rig and at least one frame, got {len(rig)} cameras and {number} frames")
    return orbit(rig, number) if kind == "orbit" else spiral(rig, number)


def focus_point(rig: Cameras) -> FloatArray:
    """Return the point [3] nearest to all optical axes, in the least-squares sense.

    Parallel axes (or a single camera) leave the distance open; then it is the rig's extent in front of its middle.
    """
    axes, centers = rig.viewmats[:, 2, :3], rig.centers
    across = np.eye(3)[None] - axes[:, :, None] * axes[:, None, :]
    matrix = across.sum(0)
    if np.linalg.cond(matrix) > 1e6:
        return np.asarray(centers.mean(0) + rig.extent * axes.mean(0))
    return np.asarray(np.linalg.solve(matrix, np.einsum("cij,cj->i", across, centers)))


def orbit(rig: Cameras, number: int) -> Cameras:
    """Return a path around the focus point at the rig's mean distance and height, starting at its first camera.

    Where cameras stand all around, one full turn; else a swing over the arc that they span and back, because nothing
    was recorded of the other side.
    """
    focus, up = focus_point(rig), up_direction(rig)
    offsets = rig.centers - focus
    height = float((offsets @ up).mean())
    radius = float(np.linalg.norm(offsets - np.outer(offsets @ up, up), axis=1).mean())
    start = offsets[0] - (offsets[0] @ up) * up
    if np.linalg.norm(start) < 1e-9:
        start = np.cross(up, [1.0, 0, 0]) if abs(up[0]) < 0.9 else np.cross(up, [0, 1.0, 0])
    first = start / np.linalg.norm(start)
    second = np.cross(up, first)
    angle = _angles(np.arctan2(offsets @ second, offsets @ first), number)
    ring = radius * (np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second)
    return _look_at(rig, focus + height * up + ring, focus, up)


def resized(rig: Cameras, width: int, height: int) -> Cameras:
    """Return the same cameras with pictures of another size.

    The vertical field of view stays, the sides show more or less.
    """
    factor = height / rig.height
    Ks = np.diag([factor, factor, 1.0]) @ rig.Ks
    Ks[:, 0, 2] += (width - factor * rig.width) / 2
    return replace(rig, Ks=Ks, width=width, height=height)


def _angles(cameras: FloatArray, number: int) -> FloatArray:
    """[number] angles of a path around cameras that stand at these angles, from that of the first (0)."""
    places = np.sort(cameras % (2 * np.pi))
    gaps = np.diff(places, append=places[0] + 2 * np.pi)
    widest = int(gaps.argmax())
    along = 2 * np.pi * np.arange(number) / number
    if gaps[widest] <= OPEN_GAP:
        return np.asarray(along)
    start, span = places[(widest + 1) % len(places)], 2 * np.pi - gaps[widest]
    half, middle = max(0.5 * span, MIN_SWING), start + 0.5 * span
    # The first camera is at angle 0 and somewhere on the arc; the swing begins there.
    first = (np.pi - middle) % (2 * np.pi) - np.pi
    phase = np.arcsin(np.clip(first / half, -1, 1))
    return np.asarray(middle + half * np.sin(along + phase))


def spiral(rig: Cameras, number: int, turns: float = 2.0) -> Cameras:
    """Return a spiral around the rig's mean position that always looks at the focus point.

    It is half as wide as the rig itself.
    """
    focus, up, centers = focus_point(rig), up_direction(rig), rig.centers
    middle = centers.mean(0)
    forward = focus - middle
    if np.linalg.norm(forward) < 1e-3 * rig.extent:
        # A ring of cameras around the scene: its middle is the scene itself, so start from one camera.
        middle = centers[0]
        forward = focus - middle
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, up)
    right = right / np.linalg.norm(right)
    above = np.cross(right, forward)
    spread = np.abs(np.stack([(centers - middle) @ right, (centers - middle) @ above]))
    reach = np.minimum(0.5 * np.percentile(spread, 80, axis=1), 0.25 * np.linalg.norm(focus - middle))
    reach = np.maximum(reach, 0.02 * np.linalg.norm(focus - middle))
    along = np.arange(number) / number
    angle = 2 * np.pi * turns * along
    size = np.sin(np.pi * along)  # opens and closes, so that the path loops
    moves = np.outer(size * np.cos(angle) * reach[0], right) + np.outer(size * np.sin(angle) * reach[1], above)
    return _look_at(rig, middle + moves, focus, up)


def _look_at(rig: Cameras, centers: FloatArray, target: FloatArray, up: FloatArray) -> Cameras:
    forward = target - centers
    forward = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, up)
    norm = np.linalg.norm(right, axis=1, keepdims=True)
    # Straight along "up" there is no horizon; the first camera's x axis stands in.
    right = np.where(norm > 1e-6, right / np.maximum(norm, 1e-6), rig.viewmats[0, 0, :3])
    down = np.cross(forward, right)
    down = down / np.linalg.norm(down, axis=1, keepdims=True)
    rotation = np.stack([np.cross(down, forward), down, forward], 1)
    viewmats = np.tile(np.eye(4), (len(centers), 1, 1))
    viewmats[:, :3, :3] = rotation
    viewmats[:, :3, 3] = -np.einsum("cij,cj->ci", rotation, centers)
    ids = tuple(f"path-{i:04d}" for i in range(len(centers)))
    return replace(rig, ids=ids, viewmats=viewmats, Ks=np.tile(rig.Ks[0], (len(centers), 1, 1)))
