"""Rigid transforms of groups of rows in torch: the rows after them, and gradient and curvature of a loss by them."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import NamedTuple

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
    to_matrix, to_product = _quadratic_forms(center.device)
    matrices = (_products(turn, turn) @ to_matrix).reshape(-1, 3, 3)
    arm = (base.means.double() - center[group])[..., None]
    means = (matrices[group] @ arm)[..., 0] + (center + transforms.translation)[group]
    quats = _products(turn[group], base.quats.double()) @ to_product
    return replace(base, means=means.float(), quats=quats.float())


def _products(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """[n, 16]: the products of the numbers of two quaternions."""
    return (a[:, :, None] * b[:, None]).reshape(-1, 16)


@functools.cache
def _quadratic_forms(device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
    """What makes of the products [16] of two quaternions' numbers a rotation matrix and their Hamilton product.

    That is [16, 9], for one quaternion of norm 1, and [16, 4]: two operations each instead of dozens. Kept.
    """
    units = torch.eye(4, dtype=torch.float64, device=device)
    first, second = units.repeat_interleave(4, 0), units.repeat(4, 1)
    # A matrix is a quadratic form, so half of what a sum of two units has beyond each of them belongs to their product.
    both, one, other = (_of_unit_norm(value) for value in (first + second, first, second))
    return 0.5 * (both - one - other), quat_multiply_torch(first, second)


@functools.cache
def _turned(device: torch.device) -> torch.Tensor:
    """[16, 3]: what makes of the products of a quaternion's gradient and the quaternion the gradient by a small turn.

    A small turn v in front of a quaternion q adds (0, v) q to it. Kept.
    """
    units = torch.eye(4, dtype=torch.float64, device=device)
    return torch.stack([quat_multiply_torch(v.expand(4, 4), units).T.flatten() for v in units[1:]], 1)


def _of_unit_norm(quats: torch.Tensor) -> torch.Tensor:
    """[n, 9]: the quadratic form that is the rotation matrix of a quaternion of norm 1, of quaternions of any norm."""
    return rotation_matrices(quats).reshape(-1, 9) * quats.square().sum(1, keepdim=True)


def transform_vjp(leaves: Gaussians[torch.Tensor], transforms: GroupTransforms[torch.Tensor]) -> torch.Tensor:
    """Return the gradient [K, 6] float64 by shift and turn of the groups, from that of the rows they have moved."""
    out = torch.zeros_like(transforms.center).repeat(1, 2)
    if leaves.means.grad is None:
        return out
    force = leaves.means.grad.double()
    arm = leaves.means.detach().double() - (transforms.center + transforms.translation)[transforms.group]
    torque = 2 * _cross(arm, force)
    if leaves.quats.grad is not None:
        torque += _products(leaves.quats.grad.double(), leaves.quats.detach().double()) @ _turned(out.device)
    return out.index_add_(0, transforms.group, torch.cat([force, torque], 1))


class Pinhole(NamedTuple):
    """A camera in float64: ``rotation`` [3, 3], ``offset`` [3] from the world to it; ``focal`` [2], pixels."""

    rotation: torch.Tensor
    offset: torch.Tensor
    focal: torch.Tensor

    @staticmethod
    def of(cameras: Cameras, view: int) -> Pinhole:
        """Return a camera of a rig, in the processor's memory."""
        pose, focal = torch.as_tensor(cameras.viewmats[view]).double(), torch.as_tensor(cameras.Ks[view]).diagonal()
        return Pinhole(pose[:3, :3], pose[:3, 3], focal[:2].double())


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
    tensor = torch.stack([xx, xy, xy, yy], 1).reshape(-1, 2, 2)
    out = by_row.new_zeros(len(transforms.center), 6, 6)
    out.index_add_(0, transforms.group, by_row.transpose(1, 2) @ tensor @ by_row)
    return out / (3 * cameras.height * cameras.width)


def _on_screen(
    means: torch.Tensor, transforms: GroupTransforms[torch.Tensor], camera: Pinhole, near: float
) -> torch.Tensor:
    """[A, 2, 6] derivative of each row's place on the screen, pixels, by shift and turn of its group."""
    rotation, offset, focal = (value.to(means.device) for value in camera)
    seen = torch.addmm(offset, means, rotation.T)
    depth = seen[:, 2:].clamp_min(near)
    aside = torch.addcmul(rotation[:2], (seen[:, :2] / depth)[..., None], rotation[2], value=-1)
    translation = aside * (focal / depth)[..., None]
    arm = means - (transforms.center + transforms.translation)[transforms.group]
    turned = _cross(arm[:, None], translation)
    return torch.cat([translation, 2 * turned], -1)


def _cross(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Cross products [..., 3], on the processor each product rounded by itself, as the compiled renderer does it."""
    if a.device.type != "cpu":
        crossed: torch.Tensor = torch.linalg.cross(a, b)
        return crossed
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
    pairs = torch.stack([right, right, down], -2), torch.stack([right, down, down], -2)
    return (weight[..., None, :] * pairs[0] * pairs[1]).sum(-1)


def _image_gradients(image: torch.Tensor, axis: int) -> torch.Tensor:
    size = image.shape[axis]
    wider = torch.cat([image.narrow(axis, 0, 1), image, image.narrow(axis, size - 1, 1)], axis)
    return 0.5 * (wider.narrow(axis, 2, size) - wider.narrow(axis, 0, size))
