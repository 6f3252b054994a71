"""Masked densification: which Gaussians are cloned or split, and what is born of them (3DGS rules)."""

from __future__ import annotations

from typing import NamedTuple

import torch

from gsstream.api import Gaussians
from gsstream_queen.settings import BirthSettings

SPLIT_SHRINK = 1.6  # 3DGS: both halves of a split Gaussian are 1.6 times smaller
SPLIT_SIZE = 0.01  # 3DGS: larger than this fraction of the extent is split, smaller is cloned


class Statistics(NamedTuple):
    """Sum of screen-gradient norms [A], half image widths, and how often each row was hit [A]."""

    total: torch.Tensor
    hits: torch.Tensor

    @staticmethod
    def zeros(number: int) -> Statistics:
        return Statistics(torch.zeros(number), torch.zeros(number))

    def add(self, gradient: torch.Tensor) -> Statistics:
        """Add one iteration's gradients [A, 2]."""
        norm = gradient.norm(dim=1)
        return Statistics(self.total + norm, self.hits + (norm > 0))

    @property
    def mean(self) -> torch.Tensor:
        return self.total / self.hits.clamp_min(1)


class Litter(NamedTuple):
    """``gaussians`` that are born, and the rows [P] of parents that they replace (those that were split)."""

    gaussians: Gaussians[torch.Tensor]
    replaced: torch.Tensor


def densify_epochs(settings: BirthSettings, epochs: int) -> frozenset[int]:
    """Epochs, counted from 1, after which Gaussians may be born."""
    if settings.every == 0 or settings.most == 0:
        return frozenset()
    numbers = range(settings.every, epochs + 1, settings.every)
    return frozenset(n for n in numbers if settings.after * epochs <= n <= settings.until * epochs)


def densify(
    rows: Gaussians[torch.Tensor], pull: torch.Tensor, may: torch.Tensor, room: int, extent: float,
    settings: BirthSettings, generator: torch.Generator,
) -> Litter:  # fmt: skip
    """Clone small and split large rows that the images pull at most.

    Arguments:
        rows: the trained rows as they are now.
        pull: [A] mean screen gradients. may: [A] bool, who may have children (dynamic rows).
        room: births at most.
        extent: of the rig, scene units.
    """
    hot = (may & (pull > settings.gradient)).nonzero()[:, 0]
    large = rows.scales.exp().amax(1) > SPLIT_SIZE * extent
    order = hot[torch.argsort(pull[hot], descending=True, stable=True)]
    cost = torch.cumsum(torch.where(large[order], 2, 1), 0)
    chosen = order[cost <= room].sort().values
    parents = torch.cat([chosen[~large[chosen]], chosen[large[chosen]].repeat_interleave(2)])
    born = rows.rows(parents).map(torch.clone)
    halves = large[parents]
    if bool(halves.any()):
        spread = torch.randn(int(halves.sum()), 3, generator=generator) * born.scales[halves].exp()
        born.means[halves] += turn(born.quats[halves], spread)
        born.scales[halves] -= torch.tensor(SPLIT_SHRINK).log()
    return Litter(born, chosen[large[chosen]])


def turn(quats: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    """[S, 3] vectors rotated by quaternions [S, 4] wxyz of any norm."""
    unit = torch.nn.functional.normalize(quats, dim=1)
    w, axis = unit[:, :1], unit[:, 1:]
    across = 2 * torch.linalg.cross(axis, vectors)
    turned: torch.Tensor = vectors + w * across + torch.linalg.cross(axis, across)
    return turned
