"""Rigid transforms of groups of rows in torch: the rows after them, and gradient and curvature of a loss by them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import torch

from gsstream.core.cameras import Cameras
from gsstream.core.changes.motion import GroupTransforms, transform_groups
from gsstream.core.gaussians import Gaussians
from gsstream.parts.render.activations import quat_multiply_torch, rotation_matrices


def transform_rows(base: Gaussians[torch.Tensor], transforms: GroupTransforms[torch.Tensor]) -> Gaussians[torch.Tensor]:
    """Return rows [A], raw values, after the transforms of their groups.

    On the processor they have the decoder's bits; elsewhere they are those within rounding to float32.
    """
    if base.means.device.type == "cpu":
        moved = transform_groups(base.map(lambda value: value.detach().numpy()), transforms.map(torch.Tensor.numpy))
        return moved.map(torch.from_numpy)
    group, center = transforms.group, transforms.center
    # axis * tan(angle / 2) is the vector part of the quaternion, in units of the scalar part.
    turn = torch.cat([torch.ones_like(center[:, :1]), transforms.rotation], 1)
    turn = turn / turn.norm(dim=1, keepdim=True)
    arm = (base.means.double() - center[group])[..., None]
    means = (rotation_matrices(turn)[group] @ arm)[..., 0] + (center + transforms.translation)[group]
    quats = quat_multiply_torch(turn[group], base.quats.double())
    return replace(base, means=means.float(), quats=quats.float())


def transform_vjp(leaves: Gaussians[torch.Tensor], transforms: GroupTransforms[torch.Tensor]) -> torch.Tensor:
    """Return the gradient [K, 6] float64 by shift and turn of the groups, from that of the rows they have moved."""
    out = torch.zeros_like(transforms.center).repeat(1, 2)
    if leaves.means.grad is None:
        return out
    force = leaves.means.grad.double()
    arm = leaves.means.detach().double() - (transforms.center + transforms.translation)[transforms.group]
    torque = 2 * _cross(arm, force)
    if leaves.quats.grad is not None:
        w, x, y, z = leaves.quats.detach().double().unbind(1)
        a, b, c, d = leaves.quats.grad.double().unbind(1)
        # A small turn v in front of a quaternion q adds (0, v) q to it.
        torque += torch.stack(
            [-a * x + b * w - c * z + d * y, -a * y + b * z + c * w - d * x, -a * z - b * y + c * x + d * w], 1
        )
    return out.index_add_(0, transforms.group, torch.cat([force, torque], 1))


class Pinhole(NamedTuple):
    """A camera as numbers, or as tensors [] where the rows are: both go along with every operation.

    ``rotation`` three rows of three, ``offset`` three: from the world to the camera. ``focal`` two, pixels.
    """

    rotation: Any
    offset: Any
    focal: Any

    @staticmethod
    def of(cameras: Cameras, view: int) -> Pinhole:
        """Return a camera of a rig as numbers: a matrix would be copied to the device of the rows."""
        pose = cameras.viewmats[view]
        return Pinhole(pose[:3, :3].tolist(), pose[:3, 3].tolist(), cameras.Ks[view].diagonal()[:2].tolist())


def curvature_of(
    means: torch.Tensor,
    transforms: GroupTransforms[torch.Tensor],
    cameras: Cameras,
    camera: Pinhole,
    structure: torch.Tensor,
) -> torch.Tensor:
    """Return the curvature [K, 6, 6] float64 of a view's loss by shift and turn of groups of rows.

    A row that moves carries its share of the picture along: at a pixel the picture changes by its gradient times the
    shift of the row on the screen, times the row's share of the pixel's light. As shares add up to at most 1, the sum
    over rows of share * (gradient * shift)^2 is at least the square of the sum, also where rows of several groups share
    a pixel: the blocks together lie above the matrix of Gauss-Newton of all groups at once, so each can be solved for
    itself. In units of the loss, which is a mean over all values of a picture; its SSIM counts as if it were L1.

    Arguments:
        means: [A, 3] centres of the rows after the move.
        transforms: of their groups.
        cameras: the rig.
        camera: the view, one of its cameras.
        structure: [A, 3] of the picture's structure tensor (xx, xy, yy), the share that each row has.
    """
    by_row = _on_screen(means.double(), transforms, camera, cameras.near_plane)
    xx, xy, yy = structure.double().unbind(1)
    tensor = torch.stack([torch.stack([xx, xy], -1), torch.stack([xy, yy], -1)], -2)
    out = by_row.new_zeros(len(transforms.center), 6, 6)
    out.index_add_(0, transforms.group, by_row.transpose(1, 2) @ tensor @ by_row)
    return out / (3 * cameras.height * cameras.width)


def _on_screen(
    means: torch.Tensor, transforms: GroupTransforms[torch.Tensor], camera: Pinhole, near: float
) -> torch.Tensor:
    """[A, 2, 6] derivative of each row's place on the screen, pixels, by shift and turn of its group."""
    rotation, offset, focal = camera
    x, y, z = means.unbind(1)
    seen = [row[0] * x + row[1] * y + row[2] * z + at for row, at in zip(rotation, offset, strict=True)]
    depth = seen[2].clamp_min(near)
    by_shift = [
        torch.stack(
            [focal[i] * (rotation[i][axis] - seen[i] / depth * rotation[2][axis]) / depth for axis in range(3)],
            1,
        )
        for i in range(2)
    ]
    translation = torch.stack(by_shift, 1)
    arm = means - (transforms.center + transforms.translation)[transforms.group]
    turned = _cross(arm[:, None], translation)
    return torch.cat([translation, 2 * turned], -1)


def _cross(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Cross products [..., 3], each product rounded by itself, as the compiled renderer does it."""
    (ax, ay, az), (bx, by, bz) = a.unbind(-1), b.unbind(-1)
    return torch.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], -1)


#: A value that is off by less than this counts as one that is off by this much, in [0, 1] image units.
MIN_ERROR = 0.03


def weighted_structure_tensor(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return [H, W, 3]: the structure tensor of a picture at every pixel, as xx, xy and yy per pixel^2.

    It is the sum over the channels of the products of the two gradients (Lucas and Kanade 1981; central differences,
    those of the border see the border again), weighed by 1 / sqrt(error^2 + MIN_ERROR^2): where a picture is shifted by
    a small d, d^T S d / 2 is the second-order term of the sum of sqrt(error^2 + MIN_ERROR^2), by the parabola that lies
    above it (iteratively reweighted least squares).
    """
    down, right = _image_gradients(image, 0), _image_gradients(image, 1)
    weight = ((image - target).square() + MIN_ERROR**2).rsqrt()
    pairs = (right, right), (right, down), (down, down)
    return torch.stack([(weight * one * other).sum(-1) for one, other in pairs], -1)


def _image_gradients(image: torch.Tensor, axis: int) -> torch.Tensor:
    last = image.shape[axis] - 1
    places = torch.arange(last + 1, device=image.device)
    after = image.index_select(axis, (places + 1).clamp_max(last))
    return 0.5 * (after - image.index_select(axis, (places - 1).clamp_min(0)))
