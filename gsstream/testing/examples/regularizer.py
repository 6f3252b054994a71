"""Price of motion: every gate that may open pays, and more so the farther it moves its Gaussians."""

from __future__ import annotations

from collections.abc import Mapping
from typing import final

import torch
from pydantic import Field

from gsstream.api import Hierarchy, PartConfig, Regularizer, RegularizerTraits, check_shape


@final
class ExampleRegularizer(Regularizer):
    """Prices open gates: the mean over Gaussians of pi (gates + motion |r|^2), pi the node's open probability."""

    source = "gsstream"

    class Config(PartConfig):
        gates: float = Field(default=0.01, ge=0, le=1e6, description="price of an open gate, loss units per Gaussian")
        motion: float = Field(default=0.01, ge=0, le=1e6, description="price of motion, loss units per squared cell")

    traits = RegularizerTraits(
        differentiable=True, reduction="mean", weights=("gates", "motion"), gate_terms=("gates",)
    )

    def penalty(
        self, open_probability: torch.Tensor, residual: torch.Tensor, hierarchy: Hierarchy, num_gaussians: int
    ) -> Mapping[str, torch.Tensor]:
        check_shape("open_probability", open_probability, (hierarchy.num_nodes,))
        check_shape("residual", residual, (hierarchy.num_gaussians, 3))
        opened = open_probability[hierarchy.node_of]
        divisor = max(num_gaussians, 1)
        return {
            "gates": opened.sum() * (self.config.gates / divisor),
            "motion": (opened * residual.square().sum(1)).sum() * (self.config.motion / divisor),
        }
