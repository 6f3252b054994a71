"""Regularizer: named penalty terms on open gates and on residuals."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

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
        gate_terms: terms that price gates alone: no residual changes them.
    """

    differentiable: bool = False
    reduction: Literal["mean", "sum"] = "mean"
    weights: tuple[str, ...] = ()
    gate_terms: tuple[str, ...] = ()


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
