"""Conversions to gsstream's convention of cameras: world to camera, OpenCV axes, pixel origin at the corner."""

from __future__ import annotations

import numpy as np

from gsstream.core.changes.motion import quat_to_rotmat
from gsstream.core.shapes import FloatArray

#: Camera axes x right, y up, z back (OpenGL, NeRF, Blender) -> x right, y down, z forward (OpenCV). Its own inverse.
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def from_opengl(camera_to_world: FloatArray) -> FloatArray:
    """Return world-to-camera matrices with OpenCV axes, given [..., 4, 4] camera-to-world with OpenGL axes."""
    return invert(camera_to_world @ OPENGL_TO_OPENCV)


def from_llff(rows: FloatArray) -> FloatArray:
    """Return [N, 4, 4] world-to-camera, given [N, 3, 4] of poses_bounds.npy.

    Those are camera-to-world, camera axes down, right, back.
    """
    pose = np.zeros((len(rows), 4, 4))
    pose[:, :3, 0] = rows[:, :, 1]  # right
    pose[:, :3, 1] = rows[:, :, 0]  # down
    pose[:, :3, 2] = -rows[:, :, 2]  # forward
    pose[:, :3, 3] = rows[:, :, 3]
    pose[:, 3, 3] = 1
    return invert(pose)


def from_quaternion(wxyz: FloatArray, translation: FloatArray) -> FloatArray:
    """Return [4, 4] world-to-camera, given wxyz [4] of any non-zero norm and translation [3] of a COLMAP image."""
    pose = np.eye(4)
    pose[:3, :3] = quat_to_rotmat(wxyz[None] / np.linalg.norm(wxyz))[0]
    pose[:3, 3] = translation
    return pose


def from_rotation_vector(vector: FloatArray) -> FloatArray:
    """Return the rotation [3, 3] of an axis times an angle in radians [3] (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation: FloatArray = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return rotation


def invert(poses: FloatArray) -> FloatArray:
    """Return the inverses of [..., 4, 4] rigid transforms: exact transposes, so that a rotation stays one."""
    out = np.zeros(poses.shape)
    rotation = np.swapaxes(poses[..., :3, :3], -1, -2)
    out[..., :3, :3] = rotation
    out[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation, poses[..., :3, 3])
    out[..., 3, 3] = 1
    return out


def from_pixel_centers(K: FloatArray) -> FloatArray:
    """Return intrinsics [..., 3, 3] with the origin at the corner of the first pixel.

    ``K`` has its origin at the centre of the first pixel, as OpenCV has.
    """
    out: FloatArray = np.array(K, np.float64)
    out[..., :2, 2] += 0.5
    return out
