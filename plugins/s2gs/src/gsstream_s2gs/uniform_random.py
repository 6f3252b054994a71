"""Uniform-random confidence: a random logit for every Gaussian."""

from __future__ import annotations

import math
from types import MappingProxyType
from typing import final

import torch
from pydantic import Field

from gsstream.api import ConfidenceEstimator, ConfidenceTraits, FrameContext, PartConfig, Rng, check_finite

#: Logits are kept in [-LIMIT, LIMIT]: probabilities from 0.001 to 0.999 (released code).
LIMIT = math.log(1000.0)


@final
class UniformRandom(ConfidenceEstimator):
    """p_i drawn from U(0, 1) for each Gaussian and frame (paper, table of confidence estimators, "Uniform Random").

    The logit of a uniform probability is a Logistic(0, 1) draw. Images are only looked at to refuse values that are not
    finite. Draws belong to rows: a permutation of the Gaussians gives them other lots.
    """

    source = "S2GS, table of confidence estimators"

    class Config(PartConfig):
        seed: int = Field(default=0, ge=0, description="seed of the draws, any integer from 0")

    denied = MappingProxyType({"check_permutation": "numbers are drawn by row index, not by Gaussian"})

    def claims(self) -> ConfidenceTraits:
        return ConfidenceTraits(floor=LIMIT)

    def estimate(self, context: FrameContext) -> torch.Tensor:
        """Logits [N] float32 in [-LIMIT, LIMIT]. Raises ShapeError when an image is not finite."""
        for view in range(len(context.cameras)):
            check_finite(f"image of view {view} at frame {context.index}", context.image(view))
        generator = Rng(self.config.seed).stream("s2gs/uniform-random", context.index)
        uniform = torch.rand(len(context.gaussians), generator=generator, dtype=torch.float64)
        # Half a step of the lattice k / 2^53: finite at both ends.
        logits = torch.logit(uniform.clamp(2.0**-54, 1 - 2.0**-53))
        return logits.clamp(-LIMIT, LIMIT).float().to(context.gaussians.means.device)
