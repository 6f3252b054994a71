"""Pinhole projection: points to pixels of a camera, and back."""

from __future__ import annotations

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.shapes import BoolArray, FloatArray


def project(points: FloatArray, cameras: Cameras, index: int) -> tuple[FloatArray, FloatArray]:
    """Return pixel positions [P, 2] (pixel-corner origin) and depths [P] of points [P, 3] in one camera of a rig.

    Positions are 0 where depth <= 0.
    """
    view, intrinsics = cameras.viewmats[index], cameras.Ks[index]
    local = points @ view[:3, :3].T + view[:3, 3]
    depth = local[:, 2]
    front = depth > 0
    homogeneous = local @ intrinsics.T
    uv = np.zeros((len(points), 2), homogeneous.dtype)
    np.divide(homogeneous[:, :2], depth[:, None], out=uv, where=front[:, None])
    return uv, depth


def inside(uv: FloatArray, depth: FloatArray, cameras: Cameras) -> BoolArray:
    """Return [P] bool: pixel positions [P, 2], at depths [P], in front of the camera and within its image."""
    seen: BoolArray = (depth > 0) & (uv >= 0).all(1) & (uv[:, 0] < cameras.width) & (uv[:, 1] < cameras.height)
    return seen


def unproject(uv: FloatArray, depth: FloatArray, cameras: Cameras, index: int) -> FloatArray:
    """Return world points [P, 3] at pixel positions [P, 2] and planar depths [P] of one camera."""
    homogeneous = np.concatenate([uv, np.ones((len(uv), 1), uv.dtype)], axis=1)
    local = (homogeneous @ np.linalg.inv(cameras.Ks[index]).T) * depth[:, None]
    view = cameras.viewmats[index]
    world: FloatArray = (local - view[:3, 3]) @ view[:3, :3]
    return world
