"""Regularizer: named penalty terms on open gates and on residuals."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal, final

import torch

from gsstream.core.hierarchy import Hierarchy
from gsstream.core.part import Part, Traits


@dataclass(frozen=True, slots=True)
class RegularizerTraits(Traits):
    """What a regularizer claims.

    Arguments:
        differentiable: gradients flow from the terms to gates and residuals.
        reduction: over Gaussians.
        weights: settings that its terms are proportional to.
        gate_terms: terms that depend on gates alone: no residual changes them.
    """

    differentiable: bool = False
    reduction: Literal["mean", "sum"] = "mean"
    weights: tuple[str, ...] = ()
    gate_terms: tuple[str, ...] = ()


@final
@dataclass(frozen=True, slots=True)
class AnalyticPenalty:
    """Closed form of a penalty: the sum over rows i of p_i (open_weight + displacement_weight |r_i|^2).

    p_i is the open probability of the row's node, r_i its position residual in cells.

    Arguments:
        open_weight: weight of a row behind an open gate.
        displacement_weight: weight of its squared position residual, per cell^2.
        mean: divide the sum by the number of Gaussians of the scene.
    """

    open_weight: float
    displacement_weight: float
    mean: bool = True

    def grad(
        self, open_probability: torch.Tensor, residual: torch.Tensor, hierarchy: Hierarchy, num_gaussians: int
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the derivatives by the probabilities [M] and by the residual [A, 3].

        Arguments:
            open_probability: [M] probability that each node's gate is not zero.
            residual: [A, 3] ungated position residual, cells.
            hierarchy: groups of the A rows.
            num_gaussians: N, the divisor of a mean.
        """
        divisor = max(num_gaussians, 1) if self.mean else 1
        rows = self.open_weight + self.displacement_weight * residual.square().sum(1)
        by_probability = torch.zeros_like(open_probability).index_add_(0, hierarchy.node_of, rows) / divisor
        weight = (2 * self.displacement_weight / divisor) * open_probability[hierarchy.node_of]
        return by_probability, weight[:, None] * residual


@final
@dataclass(frozen=True, slots=True)
class AnyPenalty:
    """A penalty that is known by calls of the part alone."""


class Regularizer(Part):
    """Each term is a finite scalar >= 0; the total is their sum; all closed and zero residual costs exactly 0."""

    traits: ClassVar[RegularizerTraits] = RegularizerTraits()

    def claims(self) -> RegularizerTraits:
        return self.traits

    @abstractmethod
    def penalty(
        self, open_probability: torch.Tensor, residual: torch.Tensor, hierarchy: Hierarchy, num_gaussians: int
    ) -> Mapping[str, torch.Tensor]:
        """Return the named terms of what the open gates of the A candidates cost.

        Arguments:
            open_probability: [M] probability that each node's gate is not zero.
            residual: [A, 3] ungated position residual in units of the anchor's cell.
            hierarchy: the hierarchy seen by the A active rows.
            num_gaussians: N, the divisor of a mean over the whole scene (closed rows contribute nothing).
        """

    def form(self) -> AnalyticPenalty | AnyPenalty:
        """Return the closed form of this penalty as it is configured, where it is that of :class:`AnalyticPenalty`.

        A compiled optimiser may use it in its inner loop instead of calling the part.
        """
        return AnyPenalty()
