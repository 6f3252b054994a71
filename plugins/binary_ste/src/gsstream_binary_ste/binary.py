"""Binary straight-through gates: a node moves entirely or not at all."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Literal, final

import torch
from pydantic import Field

from gsstream.api import GateSampler, GateTraits, PartConfig, check_finite

#: Logits are kept in [-LOGIT_BOUND, LOGIT_BOUND]: probabilities from 0.001 to 0.999 (released code).
LOGIT_BOUND = math.log(1000.0)


@final
class BinarySteGate(GateSampler):
    """g = 1 where sigmoid((z + n) / tau) > 1/2, else 0, n ~ Logistic(0, 1) (paper, "Binary STE").

    P(g = 1) = sigmoid(z) whatever tau is: the temperature shapes only the gradient, that of the soft gate, straight
    through the step.

    The paper reports that these gates collapse. In the released code a clamp follows the rounding; its derivative is 0
    at both ends, which is where every binary gate is. So no gate gets a gradient from the images, only from the
    penalty, and all of them close. ``clamp_gradient`` reproduces that; without it binary gates train.
    """

    source = 'S2GS, ablation "Binary STE"'

    class Config(PartConfig):
        temperature: float = Field(
            default=0.3, ge=0.01, le=100, description="tau, softness of the gradient, no unit, 0.01 to 100 (paper: 0.3)"
        )
        noise: Literal["logistic", "none"] = Field(
            default="logistic", description="while training; logistic: paper; none: released training"
        )
        clamp_gradient: bool = Field(
            default=False, description="block every gradient through a gate at 0 or 1, as the released clamp does"
        )

    traits = GateTraits(stochastic=True, differentiable=True, temperature=True)

    def claims(self) -> GateTraits:
        return replace(self.traits, stochastic=self.config.noise == "logistic")

    def denials(self) -> Mapping[str, str]:
        if not self.config.clamp_gradient:
            return {}
        return {"check_gate_gradient_flow": "the released clamp blocks every gradient of a 0/1 gate"}

    @property
    def num_levels(self) -> int:
        return 1

    def init(self, logits: torch.Tensor) -> torch.Tensor:
        """Start from confidence logits [M], limited to the documented bound. Raises ShapeError if one is not finite."""
        check_finite("confidence logits", logits)
        return self.bound(logits.detach())

    def noise(self, num_nodes: int, generator: torch.Generator) -> torch.Tensor | None:
        """[num_nodes] float32, or None when ``noise`` is none."""
        if self.config.noise == "none":
            return None
        # Half a step of the lattice k / 2^24: finite also where the generator gives exactly 0.
        u = torch.rand(num_nodes, generator=generator, device=generator.device).double() + 2.0**-25
        return (torch.log(u) - torch.log1p(-u)).float()

    def sample(self, logits: torch.Tensor, noise: torch.Tensor | None) -> torch.Tensor:
        """Gates [M], each exactly 0.0 or 1.0, dtype of the logits; a soft gate of exactly 1/2 is closed."""
        z = logits if noise is None else logits + noise.detach().to(logits.dtype)
        tau = self.config.temperature
        x = z.detach() / tau
        # The soft gate's derivative; s (1 - s) is exactly 0 from x = 17 on: no gradient for an open gate.
        # z - z is exactly 0, so the value is exactly 0 or 1.
        through = (z - z.detach()) * (torch.sigmoid(x) * torch.sigmoid(-x) / tau)
        if self.config.clamp_gradient:
            through = 0.0 * through
        return (z.detach() > 0).to(z.dtype) + through

    def open_probability(self, logits: torch.Tensor) -> torch.Tensor:
        """[M] sigmoid(z), the probability that z plus logistic noise is positive."""
        return torch.sigmoid(logits)

    def bound(self, logits: torch.Tensor) -> torch.Tensor:
        """Project the logits into [-LOGIT_BOUND, LOGIT_BOUND]."""
        return logits.clamp(-LOGIT_BOUND, LOGIT_BOUND)
