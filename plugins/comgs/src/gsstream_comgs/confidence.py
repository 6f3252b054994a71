"""Confidence that a Gaussian needs a correction: its screen gradient of the error is among the largest."""

from __future__ import annotations

from typing import final

import torch
from pydantic import Field

from gsstream.api import ConfidenceEstimator, ConfidenceTraits, FrameContext, PartConfig, check_finite

#: Logits of the Gaussians that are corrected, and of all others, which no gate opens for.
CORRECTED, LEFT = 1.0, -30.0


@final
class ErrorGradient(ConfidenceEstimator):
    """Gives the Gaussians with the largest mean screen gradient of the mean absolute error the logit 1, others -30."""

    source = "ComGS (NeurIPS 2025)"
    traits = ConfidenceTraits(needs_renderer=True, floor=CORRECTED)

    class Config(PartConfig):
        share: float = Field(
            default=0.3, gt=0, le=1, description="share of the Gaussians at most; those without a gradient are left"
        )

    def estimate(self, context: FrameContext) -> torch.Tensor:
        """Return logits [N] float32, 1 or -30. Raises ShapeError when a picture is not finite."""
        total = torch.zeros_like(context.gaussians.opacities)
        for view in range(len(context.cameras)):
            error = context.previous_render(view) - context.image(view)
            check_finite(f"error of view {view} at frame {context.index}", error)  # the sign of NaN would be 0
            total += context.screen_gradient(view, error.sign() / error.numel()).gradient.norm(dim=1)
        number = min(max(1, int(self.config.share * len(total))), int((total > 0).sum()))
        logits = torch.full_like(total, LEFT)
        logits[torch.topk(total, number).indices] = CORRECTED
        return logits
