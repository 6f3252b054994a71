"""Share of the largest change: the gradient of a change in the images by a Gaussian, relative to the largest."""

from __future__ import annotations

from dataclasses import replace
from typing import final

import torch
from pydantic import Field

from gsstream.api import ConfidenceEstimator, ConfidenceTraits, FrameContext, PartConfig, check_finite


@final
class ExampleConfidence(ConfidenceEstimator):
    """Compares two frames: z = gain * (|m| / max|m| - 1/2), |m| the mean over views of the screen gradient's norm.

    The gradient is that of half the squared difference of the two frames. Without a gradient, z is ``floor``.
    """

    source = "gsstream"

    class Config(PartConfig):
        gain: float = Field(default=10.0, gt=0, le=100, description="steepness, logits per share of the largest")
        floor: float = Field(default=-6.0, ge=-50, le=0, description="logit of a Gaussian without a gradient")

    traits = ConfidenceTraits(needs_renderer=True, finds_motion=True, monotone_in_change=True)

    def claims(self) -> ConfidenceTraits:
        # A share of the largest gradient: an even change of light marks a few Gaussians, never half of them.
        return replace(self.traits, floor=self.config.floor, brightness=0.0)

    def estimate(self, context: FrameContext) -> torch.Tensor:
        total = torch.zeros_like(context.gaussians.opacities, dtype=torch.float64)
        for view in range(len(context.cameras)):
            change = context.image_change(view)
            check_finite(f"change of view {view}", change)
            gradient, visible = context.screen_gradient(view, change)
            total += gradient.double().norm(dim=1) * visible
        logits = torch.full_like(total, self.config.floor)
        changed = total > 0
        if bool(changed.any()):
            share = total[changed] / total.max()
            logits[changed] = (self.config.gain * (share - 0.5)).clamp_min(self.config.floor)
        return logits.float()
