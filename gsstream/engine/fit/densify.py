"""Where frame 0 needs more Gaussians and where it has too many (3DGS rules, Kerbl et al. 2023, section 5.2)."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from gsstream.core.gaussians import Gaussians
from gsstream.engine.fit.constants import PRUNE_OPACITY
from gsstream.parts.render.activations import activate_opacities, activate_scales, rotation_matrices
from gsstream.parts.residual.adam_state import TopologyEdit

SPLIT_SHRINK = 1.6  # 3DGS: both halves of a split Gaussian are 1.6 times smaller
SPLIT_SIZE = 0.01  # 3DGS: larger than this fraction of the extent is split, smaller is cloned


@dataclass(frozen=True)
class DensifyStatistics:
    """Sum of screen-gradient norms [N] in half-width units, and the number of iterations each Gaussian was hit [N]."""

    total: torch.Tensor
    count: torch.Tensor

    @staticmethod
    def zeros(num: int, device: torch.device) -> DensifyStatistics:
        return DensifyStatistics(torch.zeros(num, device=device), torch.zeros(num, device=device))

    def to(self, device: torch.device) -> DensifyStatistics:
        """Return the same on a device."""
        return DensifyStatistics(self.total.to(device), self.count.to(device))

    def add(self, gradient: torch.Tensor) -> DensifyStatistics:
        """Add one iteration's gradients [N, 2]."""
        norm = gradient.norm(dim=1)
        return DensifyStatistics(self.total + norm, self.count + (norm > 0))

    @property
    def mean(self) -> torch.Tensor:
        return self.total / self.count.clamp_min(1)


@dataclass(frozen=True, slots=True)
class GrowthLimits:
    """Where a scene grows, and how far."""

    gradient: float  # mean screen gradient, in half image widths, above which a Gaussian is densified
    most: int  # number of Gaussians that growth never exceeds
    extent: float  # of the rig, scene units
    widest: float  # standard deviation from which a Gaussian is oversized, scene units


def grow_and_prune(
    gaussians: Gaussians[torch.Tensor],
    statistics: DensifyStatistics,
    limits: GrowthLimits,
    generator: torch.Generator,
) -> tuple[TopologyEdit, dict[str, torch.Tensor]]:
    """Clone small and split large Gaussians with large screen gradients; drop transparent and oversized ones.

    Returns the edit and the new contents of every attribute.
    """
    largest = activate_scales(gaussians.scales).amax(1)
    keep = (activate_opacities(gaussians.opacities) > PRUNE_OPACITY) & (largest < limits.widest)
    budget = max(0, limits.most - int(keep.sum()))
    score = torch.where(keep, statistics.mean, torch.zeros_like(largest))
    hot = (score > limits.gradient).nonzero()[:, 0]
    hot = hot[torch.argsort(score[hot], descending=True, stable=True)][:budget].sort().values
    split = torch.zeros_like(keep)
    split[hot] = largest[hot] > SPLIT_SIZE * limits.extent
    kept = keep.nonzero()[:, 0]
    source = torch.cat([kept, hot])
    fresh = torch.cat([split[kept], torch.ones_like(hot, dtype=torch.bool)])
    values = dict(split_or_clone(gaussians, source, split[source], generator).items())
    return TopologyEdit(source, fresh), values


def split_or_clone(
    gaussians: Gaussians[torch.Tensor], parents: torch.Tensor, halves: torch.Tensor, generator: torch.Generator
) -> Gaussians[torch.Tensor]:
    """Return copies of Gaussians, those that are halves of a split drawn from their parent and made smaller (3DGS).

    Arguments:
        gaussians: N rows, raw values.
        generator: of the positions of halves.
        parents: [P] rows that are copied.
        halves: [P] bool, copies that are one half of a split parent; the others are as their parent is.
    """
    added = gaussians.rows(parents).map(torch.clone)
    if bool(halves.any()):
        normal = torch.randn(int(halves.sum()), 3, generator=generator).to(added.means.device)
        spread = normal * activate_scales(added.scales[halves])
        turned = (rotation_matrices(added.quats[halves]) @ spread[..., None])[..., 0]
        added.means[halves] += turned
        added.scales[halves] -= float(torch.tensor(SPLIT_SHRINK).log())
    return added
