"""Propagation: from a confidence per Gaussian to a confidence per node."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch

from gsstream.core.hierarchy import Hierarchy
from gsstream.core.part import Part, Traits


@dataclass(frozen=True, slots=True)
class PropagationTraits(Traits):
    """What a propagation claims.

    Arguments:
        conservative: no node's confidence is below that of any of its Gaussians.
        idempotent: applying it twice equals applying it once.
        differentiable: gradients flow from nodes to Gaussians.
        normalised: keeps the scale: constants stay constant, the flat structure changes nothing.
        parent_bound: no node's confidence is below that of its children.
    """

    conservative: bool = False
    idempotent: bool = False
    differentiable: bool = False
    normalised: bool = False
    parent_bound: bool = False


class Propagation(Part):
    """Spreads logits over a hierarchy. Monotone; invariant to the order of Gaussians; finite in, finite out."""

    traits: ClassVar[PropagationTraits] = PropagationTraits()

    def claims(self) -> PropagationTraits:
        return self.traits

    @abstractmethod
    def propagate(self, logits: torch.Tensor, hierarchy: Hierarchy) -> torch.Tensor:
        """Return one logit per node [M], given one per Gaussian [N]."""
