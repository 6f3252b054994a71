"""Masked densification: which Gaussians are cloned or split, and what they become (3DGS rules)."""

from __future__ import annotations

from typing import NamedTuple

import torch

from gsstream.api import Gaussians
from gsstream.blocks import SPLIT_SIZE, split_or_clone
from gsstream_queen.settings import GrowthSettings


class AddedByDensify(NamedTuple):
    """``gaussians`` that are added, and the rows [P] of parents that they replace (those that were split)."""

    gaussians: Gaussians[torch.Tensor]
    replaced: torch.Tensor


def densify_epochs(settings: GrowthSettings, epochs: int) -> frozenset[int]:
    """Epochs, counted from 1, after which Gaussians may be added."""
    if settings.every == 0 or settings.max_added == 0:
        return frozenset()
    numbers = range(settings.every, epochs + 1, settings.every)
    return frozenset(n for n in numbers if settings.start * epochs <= n <= settings.stop * epochs)


def densify(
    rows: Gaussians[torch.Tensor],
    grad_norm: torch.Tensor,
    allowed: torch.Tensor,
    room: int,
    extent: float,
    settings: GrowthSettings,
    generator: torch.Generator,
) -> AddedByDensify:
    """Clone small and split large rows with the largest screen gradient."""
    hot = (allowed & (grad_norm > settings.grad_threshold)).nonzero()[:, 0]
    large = rows.scales.exp().amax(1) > SPLIT_SIZE * extent
    order = hot[torch.argsort(grad_norm[hot], descending=True, stable=True)]
    cost = torch.cumsum(torch.where(large[order], 2, 1), 0)
    chosen = order[cost <= room].sort().values
    parents = torch.cat([chosen[~large[chosen]], chosen[large[chosen]].repeat_interleave(2)])
    return AddedByDensify(split_or_clone(rows, parents, large[parents], generator), chosen[large[chosen]])
