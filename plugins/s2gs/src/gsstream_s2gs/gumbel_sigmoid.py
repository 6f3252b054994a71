"""Gumbel-sigmoid gates, rounded to a few levels with a straight-through gradient."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Literal, final

import torch
from pydantic import Field

from gsstream.api import AnalyticGate, GateSampler, GateTraits, PartConfig, SampledGate, check_finite

#: Half the spacing of float32 uniforms: moves the lattice k / 2^24 into the open interval (0, 1), symmetrically.
HALF_STEP = 2.0**-25


@final
class GumbelSigmoid(GateSampler):
    """g = round_levels(sigmoid((alpha + n) / tau)), n ~ Logistic(0, 1) (paper, "Differentiable Gate Sampling").

    * alpha is the propagated confidence logit itself; nothing passes through a probability.
    * The derivative of the soft gate is sigmoid(x) sigmoid(-x), small but alive at either end. The usual g (1 - g) is
      exactly 0 from x = 17 on in float32, so an open gate would get no gradient from the images, only from the penalty.
    * Rounding is to multiples of 1 / ``levels``: 10 is the paper's one decimal (multi-level STE), 1 its binary STE.
      The gradient is that of the soft gate (straight-through), alive also where the rounded gate is 0 or 1.
      Ties of the scaled value go to the even level, so a soft gate of exactly 0.5 / levels is closed.
    * A rounded gate is open when its soft gate exceeds eta = 0.5 / levels; with 10 levels that is the paper's eta
      of 0.05. Under logistic noise this has probability sigmoid(alpha - tau * logit(eta)) (the binary concrete's
      distribution function), which is what ``open_probability`` returns and the paper's regulariser calls pi.
    * ``sample(logits, None)`` is the deterministic gate that is transmitted.

    Released code: no noise while training, one Gumbel draw at initialisation whose result has no effect, and a clamp
    after rounding that blocks the gradient of every gate at 0 or 1; see ``noise`` and ``clamp_gradient``.
    """

    source = 'S2GS, "Differentiable Gate Sampling"'

    class Config(PartConfig):
        temperature: float = Field(
            default=0.3, ge=0.01, le=100, description="tau, softness of the gate, no unit, 0.01 to 100 (paper: 0.3)"
        )
        levels: int = Field(
            default=10, ge=1, le=255, description="non-zero gate values, 1 (binary) to 255; 10 is one decimal (paper)"
        )
        logit_bound: float = Field(
            default=math.log(1000.0),
            gt=0,
            le=50,
            description="logits are kept in [-bound, bound], 0 to 50; ln(1000) is p = 0.001 to 0.999 (released code)",
        )
        noise: Literal["logistic", "none", "gumbel"] = Field(
            default="logistic",
            description="logistic: paper; none: released training; gumbel: the law of the released initialisation",
        )
        clamp_gradient: bool = Field(
            default=False, description="block the gradient where the rounded gate is 0 or 1, as the released clamp does"
        )

    traits = GateTraits(stochastic=True, differentiable=True, temperature=True)

    def claims(self) -> GateTraits:
        return replace(self.traits, stochastic=self.config.noise != "none")

    def denials(self) -> Mapping[str, str]:
        denied = {}
        # The logit beyond which a gate is rounded to 0 or 1; the check asks for life in nine tenths of [-1, 1].
        reach = self.config.temperature * math.log(2 * self.config.levels - 1)
        if self.config.clamp_gradient and reach < 0.9:
            denied["check_gate_gradient_flow"] = "the released clamp blocks every gradient of a 0/1 gate"
        if self.config.noise == "gumbel" and self.config.levels == 1:
            denied["check_gate_init_calibrated"] = "with one Gumbel draw confidence 0.5 opens 63 % of all gates"
        return denied

    @property
    def num_levels(self) -> int:
        return self.config.levels

    def init(self, logits: torch.Tensor) -> torch.Tensor:
        """Start from confidence logits [M], limited to the documented bound. Raises ShapeError if one is not finite."""
        check_finite("confidence logits", logits)
        return self.bound(logits.detach())

    def noise(self, num_nodes: int, generator: torch.Generator) -> torch.Tensor | None:
        """[num_nodes] float32 on the generator's device, within +-17.4 (logistic); None when ``noise`` is none."""
        if self.config.noise == "none":
            return None
        uniform = torch.rand(num_nodes, generator=generator, device=generator.device)
        return logistic(uniform) if self.config.noise == "logistic" else gumbel(uniform)

    def sample(self, logits: torch.Tensor, noise: torch.Tensor | None) -> torch.Tensor:
        """Gates [M] in {0, 1/levels, ..., 1}, dtype of the logits."""
        alpha = logits if noise is None else logits + noise.detach().to(logits.dtype)
        x = alpha.detach() / self.config.temperature
        soft = torch.sigmoid(x)
        # Divided by a tensor, not by a number: some devices turn the latter into a product with 1/levels, which is not
        # the value the decoder computes.
        steps = soft.new_full((), float(self.num_levels))
        hard = torch.round(soft * steps) / steps
        # alpha - alpha is exactly 0, so the value is exactly the level; soft + (hard - soft) would be an ulp off.
        through = (alpha - alpha.detach()) * (sigmoid_derivative(x, soft) / self.config.temperature)
        if self.config.clamp_gradient:
            through = through * ((hard > 0) & (hard < 1))
        return hard + through

    def open_probability(self, logits: torch.Tensor) -> torch.Tensor:
        """[M] P(rounded gate > 0) under the noise law; without noise the logistic form (as the released code does)."""
        margin = logits - self._margin
        if self.config.noise == "gumbel":
            # Beyond 30 the probability is 1 in any float, while exp would overflow and its gradient become 0 * inf.
            return -torch.expm1(-torch.exp(margin.clamp_max(30.0)))
        return torch.sigmoid(margin)

    def form(self) -> AnalyticGate | SampledGate:
        """The formulas above, without noise and without the released clamp."""
        if self.config.noise != "none" or self.config.clamp_gradient:
            return SampledGate()
        return AnalyticGate(self.config.temperature, self.num_levels, self._margin, self.config.logit_bound)

    @property
    def _margin(self) -> float:
        """The logit whose soft gate is eta."""
        eta = 0.5 / self.num_levels
        return self.config.temperature * math.log(eta / (1 - eta))

    def bound(self, logits: torch.Tensor) -> torch.Tensor:
        """Project the logits into [-logit_bound, logit_bound]."""
        return logits.clamp(-self.config.logit_bound, self.config.logit_bound)


def sigmoid_derivative(x: torch.Tensor, value: torch.Tensor) -> torch.Tensor:
    """Derivative of the sigmoid, given its value at x; accurate at both ends, where s (1 - s) loses all digits."""
    return value * torch.sigmoid(-x)


def logistic(uniform: torch.Tensor) -> torch.Tensor:
    """Logistic(0, 1) from float32 uniforms in [0, 1); finite also at u = 0 and u = 1 - 2^-24."""
    u = uniform.double() + HALF_STEP
    return (torch.log(u) - torch.log1p(-u)).float()


def gumbel(uniform: torch.Tensor) -> torch.Tensor:
    """Gumbel(0, 1) from float32 uniforms in [0, 1); finite also at the ends."""
    return (-torch.log(-torch.log(uniform.double() + HALF_STEP))).float()
