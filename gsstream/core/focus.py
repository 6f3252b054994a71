"""What a rig looks at: the point at which its optical axes meet."""

from __future__ import annotations

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.shapes import FloatArray

#: Mean squared angle between optical axes, radians, below which a calibration cannot say where they meet.
PARALLEL = 1e-4
#: Cameras whose mean direction is at least this long look one way, though perhaps a little apart.
ONE_WAY = 0.9
#: Weight with which the point is drawn to the middle of the cameras, beside that of the axes.
TO_MIDDLE = 1e-4


def meeting_point(cameras: Cameras) -> FloatArray | None:
    """Return the point [3] nearest to all optical axes (least squares), which may lie behind the cameras.

    Axes that are all but parallel leave the distance open. Of cameras that face each other, or stand back to back, the
    point is their middle, because every point is drawn weakly to that. Of cameras that look one way, there is none.
    """
    axes, centers = cameras.viewmats[:, 2, :3], cameras.centers
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    if np.linalg.det(across.mean(0)) < PARALLEL and looks_one_way(cameras):
        return None
    weight = TO_MIDDLE * len(cameras)
    right = np.einsum("cij,cj->i", across, centers) + weight * centers.mean(0)
    point: FloatArray = np.linalg.solve(across.sum(0) + weight * np.eye(3), right)
    return point


def focus_point(cameras: Cameras) -> FloatArray:
    """Return the point [3] where the optical axes meet, else the point as far before the rig as the rig is wide."""
    point = meeting_point(cameras)
    return point_ahead(cameras) if point is None else point


def point_ahead(cameras: Cameras) -> FloatArray:
    """Return the point [3] before the middle of the cameras, at the distance of their extent."""
    ahead = cameras.viewmats[:, 2, :3].mean(0)
    return np.asarray(cameras.centers.mean(0) + cameras.extent * ahead / np.linalg.norm(ahead))


def looks_one_way(cameras: Cameras) -> bool:
    """Say whether the cameras look in one direction on the whole."""
    return float(np.linalg.norm(cameras.viewmats[:, 2, :3].mean(0))) >= ONE_WAY
