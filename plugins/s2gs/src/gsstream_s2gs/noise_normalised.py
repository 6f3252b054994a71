"""Noise-normalised confidence: change counted in units of what each camera's noise alone would do."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import final

import torch
from pydantic import Field

from gsstream.api import ConfidenceEstimator, ConfidenceTraits, FrameContext, PartConfig
from gsstream_s2gs.noise_ratios import noise_ratios


@final
class NoiseNormalised(ConfidenceEstimator):
    """z_i = gain (r_i - threshold), r_i^2 = sum_v |g_iv|^2 / sum_v E|n_iv|^2.

    g_iv is the view-space gradient that the change of view v between two frames exerts on Gaussian i, the change being
    divided by that camera's noise; n_iv the same of unit noise, measured with seeded draws. So r is about 1 for a scene
    that stands still, whatever its cameras, its units and its resolution, and a still scene opens nothing; the robust
    normalisation of the paper has no such zero, because a median always leaves half of all Gaussians above it.

    Energies are summed over views: the vectors of different views live in different image planes.
    """

    source = "gsstream"

    class Config(PartConfig):
        threshold: float = Field(
            default=4.0, gt=0, le=1000, description="r at which p = 0.5, in units of the noise, up to 1000"
        )
        gain: float = Field(default=1.0, gt=0, le=100, description="logit per unit of r, 0 to 100")
        min_sigma: float = Field(
            default=0.4 / 255, gt=0, le=1,
            description="least noise of a camera, image units; 0.4/255 is 8-bit rounding of two frames",
        )  # fmt: skip
        probes: int = Field(
            default=2, ge=1, le=64, description="noise draws per view, 1 to 64; each costs one backward pass"
        )
        seed: int = Field(default=0, ge=0, description="seed of the noise draws, any integer from 0")
        floor: float = Field(
            default=-math.log(1000.0), ge=-50, le=0, description="logit where nothing changes, -50 to 0"
        )
        limit: float = Field(default=50.0, gt=0, le=1e4, description="logits are kept in [-limit, limit]")

    traits = ConfidenceTraits(needs_renderer=True, finds_motion=True, monotone_in_change=True)

    def claims(self) -> ConfidenceTraits:
        return replace(self.traits, floor=self.config.floor)

    def estimate(self, context: FrameContext) -> torch.Tensor:
        """Logits [N] float32 in [-limit, limit]. Raises ShapeError when a gradient is not finite."""
        config = self.config
        found = noise_ratios(context, config.min_sigma, config.probes, config.seed, error=False)
        logits = config.gain * (found.change_ratio - config.threshold)
        logits = logits.where(found.change_ratio > 0, torch.full_like(logits, config.floor))
        return logits.clamp(-config.limit, config.limit).float()
