"""The names of a Gaussian's axes: of 24 quaternions that draw the same, frame 0 keeps the one nearest to no rotation.

An ellipsoid does not say which of its axes is the first, nor which way it points, so a quaternion may be followed by
any rotation that takes axes to axes, when the scales change places with them. The quaternions that remain lie within
63 degrees of no rotation and are told apart by two bits less.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import torch

from gsstream.core.gaussians import Gaussians
from gsstream.parts.render.activations import quat_multiply_torch, rotation_matrices

_HALF = 0.5**0.5


def nearest_axes(gaussians: Gaussians[torch.Tensor]) -> Gaussians[torch.Tensor]:
    """Return Gaussians that draw the same, with unit quaternions whose first component is largest, at least 0.85."""
    quats = gaussians.quats.double()
    quats = quats / quats.norm(dim=1, keepdim=True)
    # [N, 24]: first component of the product of each quaternion with each of the rotations.
    first = quats @ quat_conjugate(_ROTATIONS).T
    rotation = first.abs().argmax(1)
    turned = quat_multiply_torch(quats, _ROTATIONS[rotation])
    turned = turned * turned[:, :1].sign()
    scales = gaussians.scales.gather(1, _PLACES[rotation])
    return replace(gaussians, quats=turned.to(gaussians.quats.dtype), scales=scales)


def _rotations() -> torch.Tensor:
    """[24, 4] unit quaternions of the rotations that take axes to axes, one of each pair of opposite signs."""
    units = torch.eye(4).tolist()
    halves = [[0.5, *(0.5 * s for s in signs)] for signs in itertools.product((1, -1), repeat=3)]
    edges = []
    for one, other in itertools.combinations(range(4), 2):
        for sign in (1, -1):
            edge = [0.0] * 4
            edge[one], edge[other] = _HALF, sign * _HALF
            edges.append(edge)
    return torch.tensor([*units, *halves, *edges], dtype=torch.float64)


def quat_conjugate(quats: torch.Tensor) -> torch.Tensor:
    """Return the conjugates [n, 4] of quaternions [n, 4], wxyz: of unit ones the turns back."""
    return quats * torch.tensor([1.0, -1.0, -1.0, -1.0])


_ROTATIONS = _rotations()
#: [24, 3]: the axis whose scale comes to each place.
_PLACES = rotation_matrices(_ROTATIONS).abs().argmax(1)
