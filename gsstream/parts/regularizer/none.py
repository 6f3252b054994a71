"""No regulariser: nothing costs anything."""

from __future__ import annotations

from collections.abc import Mapping
from typing import final

import torch

from gsstream.core.hierarchy import Hierarchy
from gsstream.parts.regularizer.base import AnalyticPenalty, Regularizer


@final
class NoRegularizer(Regularizer):
    """No terms."""

    source = "gsstream"

    def penalty(
        self, open_probability: torch.Tensor, residual: torch.Tensor, hierarchy: Hierarchy, num_gaussians: int
    ) -> Mapping[str, torch.Tensor]:
        return {}

    def form(self) -> AnalyticPenalty:
        return AnalyticPenalty(0.0, 0.0)
