"""Uniform confidence: every Gaussian is equally likely to have changed."""

from __future__ import annotations

from typing import final

import torch
from pydantic import Field

from gsstream.core.context import FrameContext
from gsstream.core.part import PartConfig
from gsstream.parts.confidence.base import ConfidenceEstimator, ConfidenceTraits


@final
class Uniform(ConfidenceEstimator):
    """The same logit for all; large values give the paper's constant-one ablation."""

    source = "gsstream"

    class Config(PartConfig):
        logit: float = Field(default=0.0, ge=-50, le=50, description="logit of the confidence, -50 to 50; 0 is p = 0.5")

    def claims(self) -> ConfidenceTraits:
        return ConfidenceTraits(floor=self.config.logit, brightness=self.config.logit)

    def estimate(self, context: FrameContext) -> torch.Tensor:
        return torch.full_like(context.gaussians.opacities, self.config.logit)
