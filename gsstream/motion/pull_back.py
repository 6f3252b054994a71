"""From gradients of moved Gaussians to gradients of the transforms that moved them."""

from __future__ import annotations

import numpy as np
import torch

from gsstream.core.changes.motion import Moves, transformed
from gsstream.core.context import FrameWork
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray
from gsstream.motion.curvature import curvature_of


def slope_of(
    work: FrameWork, view: int, base: Gaussians[FloatArray], moves: Moves, near_change: bool = False
) -> FloatArray:
    """Return the gradient [K, 6] of a view's loss with respect to shift and turn of the groups, at these moves.

    Arguments:
        work: the frame, narrowed to the rows that move.
        view: index of a training camera.
        base: these A rows before they move.
        moves: of the rows of ``base``: its ``rows`` count from 0 to A - 1.
        near_change: as for ``work.pull``.
    """
    pulled = work.pull_moved(view, base, moves, near_change)
    if pulled is not None:
        return pulled.slope
    return pulled_back(_moved_leaves(work, view, base, moves, near_change), moves)


def curved_slope_of(
    work: FrameWork, view: int, base: Gaussians[FloatArray], moves: Moves, near_change: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Return the gradient [K, 6] as :func:`slope_of`, and the curvature [K, 6, 6] of the groups, at these moves.

    Arguments:
        work, view, base, moves, near_change: as for :func:`slope_of`.
    """
    pulled = work.pull_moved(view, base, moves, near_change, curved=True)
    if pulled is not None and pulled.curvature is not None:
        return pulled.slope, pulled.curvature
    leaves = _moved_leaves(work, view, base, moves, near_change)
    structure = work.structure(view, leaves.map(torch.Tensor.detach), near_change)
    means = leaves.means.detach().numpy()
    return pulled_back(leaves, moves), curvature_of(means, moves, work.cameras, view, structure)


def _moved_leaves(
    work: FrameWork, view: int, base: Gaussians[FloatArray], moves: Moves, near_change: bool
) -> Gaussians[torch.Tensor]:
    """The rows after they moved, with the gradient of a view's loss."""
    leaves = transformed(base, moves).map(lambda value: torch.from_numpy(value).requires_grad_())
    work.pull(view, leaves, near_change)
    return leaves


def pulled_back(leaves: Gaussians[torch.Tensor], moves: Moves) -> FloatArray:
    """Return the gradient [K, 6] by shift and turn of the groups, from that of the rows that they have moved.

    Arguments:
        leaves: the A rows after they moved, with their gradients.
        moves: of these rows, which it counts from 0 to A - 1.
    """
    number = len(moves.centre)
    if leaves.means.grad is None:
        return np.zeros((number, 6))
    force = leaves.means.grad.numpy().astype(np.float64)
    arm = leaves.means.detach().numpy() - (moves.centre + moves.shift)[moves.place]
    torque = 2 * np.cross(arm, force)
    if leaves.quats.grad is not None:
        w, x, y, z = leaves.quats.detach().numpy().astype(np.float64).T
        a, b, c, d = leaves.quats.grad.numpy().astype(np.float64).T
        # A small turn v in front of a quaternion q adds (0, v) q to it.
        torque += np.stack([
            -a * x + b * w - c * z + d * y, -a * y + b * z + c * w - d * x, -a * z - b * y + c * x + d * w
        ], 1)  # fmt: skip
    both = np.concatenate([force, torque], 1)
    return np.stack([np.bincount(moves.place, both[:, i], number) for i in range(6)], 1)
