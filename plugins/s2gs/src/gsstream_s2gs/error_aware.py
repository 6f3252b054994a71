"""Error-aware confidence: what changed, and what was never right, within a budget."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import final

import torch
from pydantic import Field

from gsstream.api import ConfidenceEstimator, ConfidenceTraits, FrameContext, PartConfig
from gsstream_s2gs.noise_ratios import noise_ratios


@final
class ErrorAware(ConfidenceEstimator):
    """Change as in ``noise-normalised``, or persistent reducible error; the paper looks at change alone.

    A gated stream keeps the defects of its first frame for ever, because gates open where the recording changes. Here a
    share ``budget`` of the Gaussians that did not change opens too: those with the largest gradient of the render's
    error in *both* frames, in units of the noise. Error that no move of a Gaussian reduces has no gradient. In turn: of
    the first ``turns`` budgets of candidates, every frame takes every ``turns``-th, so that a defect which cannot be
    mended does not hold its place in every frame.

    Recipes that use it set ``stream.change_threshold`` 0, since the active set otherwise leaves out whatever stands
    still, and ``stream.active_threshold`` above the probability of ``floor``, so that this part alone decides who takes
    part and the cost follows its decision.
    """

    source = "gsstream"

    class Config(PartConfig):
        threshold: float = Field(
            default=4.0, gt=0, le=1000, description="change at which p = 0.5, in units of the noise, up to 1000"
        )
        gain: float = Field(default=1.0, gt=0, le=100, description="logit per unit of change, 0 to 100")
        budget: float = Field(
            default=0.02, ge=0, le=1, description="share of Gaussians that may open for error alone, 0 to 1"
        )
        turns: int = Field(default=4, ge=1, le=1000, description="frames after which a candidate's turn returns")
        error_threshold: float = Field(
            default=4.0, gt=0, le=1e6, description="least error of a candidate, in units of the noise"
        )
        error_logit: float = Field(
            default=1.0, ge=-10, le=50, description="logit of Gaussians that open for error, -10 to 50"
        )
        min_sigma: float = Field(
            default=0.4 / 255, gt=0, le=1, description="least noise of a camera, image units"
        )
        probes: int = Field(default=2, ge=1, le=64, description="noise draws per view, 1 to 64")
        seed: int = Field(default=0, ge=0, description="seed of the noise draws, any integer from 0")
        floor: float = Field(
            default=-math.log(1000.0), ge=-50, le=0, description="logit of everybody else where nothing changes"
        )
        limit: float = Field(default=50.0, gt=0, le=1e4, description="logits are kept in [-limit, limit]")

    traits = ConfidenceTraits(needs_renderer=True, finds_motion=True)

    def claims(self) -> ConfidenceTraits:
        # With a budget, what stands still may open for its error; that is the point.
        opened = self.config.error_logit if self.config.budget > 0 else self.config.floor
        floor = max(self.config.floor, opened)
        return replace(self.traits, monotone_in_change=self.config.budget == 0, floor=floor)

    def estimate(self, context: FrameContext) -> torch.Tensor:
        """Logits [N] float32 in [-limit, limit]. Raises ShapeError when a gradient is not finite."""
        config = self.config
        found = noise_ratios(context, config.min_sigma, config.probes, config.seed, error=config.budget > 0)
        logits = config.gain * (found.change_ratio - config.threshold)
        # Below the threshold there is no change to speak of: one defined value, which the active set can tell.
        logits = logits.where(found.change_ratio > config.threshold, torch.full_like(logits, config.floor))
        chosen = self._turn(found.error_ratio, found.change_ratio > config.threshold, context.index)
        logits[chosen] = config.error_logit
        return logits.clamp(-config.limit, config.limit).float()

    def _turn(self, error: torch.Tensor, changed: torch.Tensor, index: int) -> torch.Tensor:
        """Rows whose turn it is: every ``turns``-th of the worst, at most ``budget`` of all."""
        count = int(self.config.budget * len(error))
        turns = self.config.turns
        wanting = torch.where(changed, torch.zeros_like(error), error)
        worst = torch.argsort(wanting, descending=True, stable=True)[: count * turns]
        worst = worst[wanting[worst] > self.config.error_threshold]
        return worst[index % turns :: turns]
