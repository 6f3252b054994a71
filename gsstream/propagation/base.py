"""Propagation: from a confidence per Gaussian to a confidence per node."""

from __future__ import annotations

from abc import abstractmethod

import torch

from gsstream.core.hierarchy import Hierarchy
from gsstream.core.part import Part


class Propagation(Part):
    """Spreads logits over a hierarchy. Monotone; invariant to the order of Gaussians; finite in, finite out."""

    @abstractmethod
    def propagate(self, logits: torch.Tensor, hierarchy: Hierarchy) -> torch.Tensor:
        """[N] logits -> [M] logits."""
