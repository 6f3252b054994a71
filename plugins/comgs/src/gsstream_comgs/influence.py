"""The field of a few key points: every Gaussian near them moves by the weighted sum of their rigid motions."""

from __future__ import annotations

from typing import NamedTuple

import torch

from gsstream.blocks import rotation_matrices


class KeyPoints(NamedTuple):
    """K key points; ``centre`` is fixed, the others are trained.

    ``centre``, ``shift`` [K, 3] scene units, ``turn`` [K, 3] axis * tan(angle / 2); of the ellipsoid that they
    influence: ``size`` [K, 3] log of the standard deviations, ``quat`` [K, 4].
    """

    centre: torch.Tensor
    shift: torch.Tensor
    turn: torch.Tensor
    size: torch.Tensor
    quat: torch.Tensor


class Field(NamedTuple):
    """Motion of A Gaussians: ``shift`` [A, 3] of their centres, ``turn`` [A, 3] axis * tan(angle / 2)."""

    shift: torch.Tensor
    turn: torch.Tensor


def weights_of(means: torch.Tensor, points: KeyPoints) -> torch.Tensor:
    """Return [A, K]: how much each key point moves each Gaussian, 0 to 1; the sum over key points is at most 1."""
    # Distances as one product of tables: squares of x against the metric of each key point, about the points' mean.
    middle = points.centre.mean(0)
    x, c = means - middle, points.centre - middle
    turned = rotation_matrices(points.quat).transpose(1, 2) / points.size.exp()[:, :, None]
    metric = turned.transpose(1, 2) @ turned
    mapped = torch.einsum("kij,kj->ki", metric, c)
    squares = (x[:, :, None] * x[:, None]).flatten(1)
    distance = squares @ metric.flatten(1).T - 2 * x @ mapped.T + (mapped * c).sum(1)
    weights = torch.exp(-0.5 * distance.clamp_min(0))
    return weights / weights.sum(1, keepdim=True).clamp_min(1)


def field_of(means: torch.Tensor, points: KeyPoints) -> Field:
    """Return how key points move Gaussians."""
    weights = weights_of(means, points)
    unit = torch.cat([torch.ones_like(points.turn[:, :1]), points.turn], 1)
    turning = rotation_matrices(unit) - torch.eye(3)
    # sum_k w (R_k - 1)(x - c_k) + w t_k, without the table [A, K, 3] of every key point's own displacement.
    blended = (weights @ turning.flatten(1)).reshape(-1, 3, 3)
    fixed = points.shift - torch.einsum("kij,kj->ki", turning, points.centre)
    shift = (blended @ means[:, :, None])[:, :, 0] + weights @ fixed
    return Field(shift, weights @ points.turn)
