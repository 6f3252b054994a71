"""Gradient and curvature of a view's loss by the rigid transforms of groups of rows."""

from __future__ import annotations

import numpy as np
import torch

from gsstream.core.cameras import Cameras
from gsstream.core.changes.motion import GroupTransforms
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray


def transform_vjp(leaves: Gaussians[torch.Tensor], transforms: GroupTransforms) -> FloatArray:
    """Return the gradient [K, 6] by shift and turn of the groups, from that of the rows that they have moved."""
    number = len(transforms.center)
    if leaves.means.grad is None:
        return np.zeros((number, 6))
    force = leaves.means.grad.numpy().astype(np.float64)
    arm = leaves.means.detach().numpy() - (transforms.center + transforms.translation)[transforms.group]
    torque = 2 * np.cross(arm, force)
    if leaves.quats.grad is not None:
        w, x, y, z = leaves.quats.detach().numpy().astype(np.float64).T
        a, b, c, d = leaves.quats.grad.numpy().astype(np.float64).T
        # A small turn v in front of a quaternion q adds (0, v) q to it.
        torque += np.stack([
            -a * x + b * w - c * z + d * y, -a * y + b * z + c * w - d * x, -a * z - b * y + c * x + d * w
        ], 1)  # fmt: skip
    both = np.concatenate([force, torque], 1)
    return np.stack([np.bincount(transforms.group, both[:, i], number) for i in range(6)], 1)


def curvature_of(
    means: FloatArray, transforms: GroupTransforms, cameras: Cameras, view: int, structure: FloatArray
) -> FloatArray:
    """Return the curvature [K, 6, 6] of a view's loss by shift and turn of groups of rows.

    A row that moves carries its share of the picture along: at a pixel the picture changes by its slope times the
    shift of the row on the screen, times the row's share of the pixel's light. As shares add up to at most 1, the sum
    over rows of share * (slope * shift)^2 is at least the square of the sum, also where rows of several groups share a
    pixel: the blocks together lie above the matrix of Gauss-Newton of all groups at once, so each can be solved for
    itself. In units of the loss, which is a mean over all values of a picture; its SSIM counts as if it were L1.
    """
    by_row = _on_screen(means, transforms, cameras, view)
    xx, xy, yy = structure.T.astype(np.float64)
    tensor = np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2)
    out = np.zeros((len(transforms.center), 6, 6))
    np.add.at(out, transforms.group, np.swapaxes(by_row, 1, 2) @ tensor @ by_row)
    return out / (3 * cameras.height * cameras.width)


def _on_screen(means: FloatArray, transforms: GroupTransforms, cameras: Cameras, view: int) -> FloatArray:
    """[A, 2, 6] derivative of each row's place on the screen, pixels, by shift and turn of its group."""
    rotation, focal = cameras.viewmats[view, :3, :3], np.diag(cameras.Ks[view])[:2]
    seen = means @ rotation.T + cameras.viewmats[view, :3, 3]
    depth = np.maximum(seen[:, 2], cameras.near_plane)
    tangents = (seen[:, :2] / depth[:, None])[..., None]
    translation = (focal / depth[:, None])[..., None] * (rotation[:2] - tangents * rotation[2])
    arm = means - (transforms.center + transforms.translation)[transforms.group]
    return np.concatenate([translation, 2 * np.cross(arm[:, None], translation)], -1)
