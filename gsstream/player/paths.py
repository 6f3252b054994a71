"""Camera paths from a calibrated rig: around the point it looks at, a spiral around its middle; other sizes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.errors import ShapeError
from gsstream.core.shapes import FloatArray
from gsstream.core.world import up_direction
from gsstream.player.region import Region, level_axes, recorded_region

PATHS = ("orbit", "spiral")


def camera_path(kind: str, rig: Cameras, number: int, region: Region | None = None) -> Cameras:
    """Return ``number`` cameras along the path ``kind`` (one of PATHS), with the intrinsics of the rig's first.

    Arguments:
        kind: a name of PATHS.
        rig: cameras of the stream.
        number: number of cameras, at least 1.
        region: region that an orbit stays in; None: that of the rig.
    """
    if kind not in PATHS:
        raise ShapeError(f"no camera path {kind!r}; known: {', '.join(PATHS)}")
    if len(rig) == 0 or number < 1:
        raise ShapeError(f"a path needs a rig and at least one frame, got {len(rig)} cameras and {number} frames")
    return orbit(rig, number, region or recorded_region(rig)) if kind == "orbit" else spiral(rig, number)


def orbit(rig: Cameras, number: int, region: Region) -> Cameras:
    """Return a path around the focus of a region at the rig's mean distance and height, starting at its first camera.

    Where cameras stand all around, one full turn; else a swing over the arc that they span and back, because nothing
    was recorded of the other side. Where the cameras look outward, those of the path do, too.
    """
    arms = region.arms(rig)
    azimuth, elevation = region.angles(arms)
    angle = _angles(region, float(azimuth[0]), number)
    first, second = level_axes(region.up)
    level = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
    arm = np.cos(elevation.mean()) * level + np.sin(elevation.mean()) * region.up
    distance = float(np.linalg.norm(rig.centers - region.focus, axis=1).mean())
    centers = region.focus + distance * arm
    return _look_at(rig, centers, centers + arm if region.outward else region.focus, region.up)


def joined(rigs: Sequence[Cameras]) -> Cameras:
    """Return the cameras of several rigs as one, with pictures of the size of the first."""
    first = rigs[0]
    scaled = [rig.scaled(first.width, first.height) for rig in rigs]
    return replace(
        first,
        ids=tuple(name for rig in rigs for name in rig.ids),
        viewmats=np.concatenate([rig.viewmats for rig in scaled]),
        Ks=np.concatenate([rig.Ks for rig in scaled]),
    )


def resized(rig: Cameras, width: int, height: int) -> Cameras:
    """Return the same cameras with pictures of another size.

    The vertical field of view stays, the sides show more or less.
    """
    factor = height / rig.height
    Ks = np.diag([factor, factor, 1.0]) @ rig.Ks
    Ks[:, 0, 2] += (width - factor * rig.width) / 2
    return replace(rig, Ks=Ks, width=width, height=height)


def _angles(region: Region, start: float, number: int) -> FloatArray:
    """[number] azimuths of a path within a region, from that of the first camera."""
    along = 2 * np.pi * np.arange(number) / number
    if region.azimuth is None:
        return np.asarray(start + along)
    middle, half = region.azimuth
    # The first camera is somewhere on the arc; the swing begins there.
    first = (start - middle + np.pi) % (2 * np.pi) - np.pi
    phase = np.arcsin(np.clip(first / half, -1, 1))
    return np.asarray(middle + half * np.sin(along + phase))


def spiral(rig: Cameras, number: int, turns: float = 2.0) -> Cameras:
    """Return a spiral around the rig's mean position that always looks at the focus point.

    It is half as wide as the rig itself.
    """
    focus, up, centers = recorded_region(rig).focus, up_direction(rig), rig.centers
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
