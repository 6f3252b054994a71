"""Expected sparsity: a penalty on the probability of open gates, and on motions behind open gates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal, final

import torch
from pydantic import Field

from gsstream.api import AnalyticPenalty, Hierarchy, PartConfig, Regularizer, RegularizerTraits, ShapeError, check_shape


@final
class ExpectedSparsity(Regularizer):
    """mean_i pi_i (lambda1 + lambda2 ||delta o_i||^2) (paper, equation of L_reg).

    pi_i is the open probability of the Gaussian's node, delta o_i its ungated position residual in cells. The paper
    prints a sum over i; with its weights of 0.01 a sum outweighs the image loss by orders of magnitude, and the
    released code takes the mean over all N Gaussians. The mean is the default, the sum an option. The released code
    also writes the second term as 0.5 * lambda2 * mean over the three axes, i.e. a sixth of the paper's.

    Sums are taken per node and in double precision: with 1e7 Gaussians neither the value nor the gradient of a node
    loses digits.
    """

    source = "S2GS, equation of L_reg"

    class Config(PartConfig):
        lambda1: float = Field(
            default=0.01, ge=0, le=1e6, description="price of an open gate, loss units per Gaussian (paper: 0.01)"
        )
        lambda2: float = Field(
            default=0.01, ge=0, le=1e6, description="price of squared motion, loss units per cell^2 (paper: 0.01)"
        )
        reduction: Literal["mean", "sum"] = Field(
            default="mean", description="over Gaussians; mean: released code; sum: as printed in the paper"
        )
        motion: Literal["squared-norm", "half-mean"] = Field(
            default="squared-norm",
            description="squared-norm: ||delta o||^2 (paper); half-mean: half the mean over the axes (released code)",
        )

    traits = RegularizerTraits(
        differentiable=True, reduction="mean", weights=("lambda1", "lambda2"), gate_terms=("sparsity",)
    )

    def claims(self) -> RegularizerTraits:
        return replace(self.traits, reduction=self.config.reduction)

    def penalty(
        self, open_probability: torch.Tensor, residual: torch.Tensor, hierarchy: Hierarchy, num_gaussians: int
    ) -> Mapping[str, torch.Tensor]:
        """Terms ``sparsity`` (gates) and ``motion`` (residuals), scalars in the dtype of ``open_probability``."""
        rows = hierarchy.num_gaussians
        check_shape("residual", residual, (rows, 3))
        check_shape("open_probability", open_probability, (hierarchy.num_nodes,))
        if num_gaussians < rows:
            raise ShapeError(f"num_gaussians: expected at least the {rows} active rows, got {num_gaussians}")
        divisor = max(num_gaussians, 1) if self.config.reduction == "mean" else 1
        probability = open_probability.double()
        squares = residual.double().square().sum(1)
        # Members are counted by the same sum: to count them in bins, a GPU is waited for.
        both = torch.stack([torch.ones_like(squares), squares])
        by_node = probability.new_zeros(2, len(probability)).index_add(1, hierarchy.node_of, both)
        members, energy = (probability * by_node).sum(1).unbind()
        weight = self.form().displacement_weight
        terms = {"sparsity": members * (self.config.lambda1 / divisor), "motion": energy * (weight / divisor)}
        return {name: term.to(open_probability.dtype) for name, term in terms.items()}

    def form(self) -> AnalyticPenalty:
        """The same sum as a formula."""
        weight = self.config.lambda2 * (1.0 if self.config.motion == "squared-norm" else 0.5 / 3)
        return AnalyticPenalty(self.config.lambda1, weight, self.config.reduction == "mean")
