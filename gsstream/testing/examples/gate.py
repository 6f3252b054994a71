"""Threshold gates: open or closed, with a straight-through gradient."""

from __future__ import annotations

from typing import final

import torch
from pydantic import Field

from gsstream.api import GateSampler, GateTraits, PartConfig, check_finite


@final
class ExampleGate(GateSampler):
    """Opens a gate by chance while training: g = 1 where z + n > 0, else 0, with n ~ Logistic(0, 1).

    So P(g = 1) = sigmoid(z). The gradient is that of sigmoid((z + n) / temperature), straight through the step.
    """

    source = "gsstream"

    class Config(PartConfig):
        temperature: float = Field(default=0.5, ge=0.05, le=10, description="softness of the gradient, no unit")
        bound: float = Field(default=7.0, gt=0, le=50, description="logits are kept in [-bound, bound]")

    traits = GateTraits(stochastic=True, differentiable=True, temperature=True)

    @property
    def num_levels(self) -> int:
        return 1

    def init(self, logits: torch.Tensor) -> torch.Tensor:
        check_finite("logits", logits)
        return self.bound(logits.detach())

    def noise(self, num_nodes: int, generator: torch.Generator) -> torch.Tensor | None:
        # Half a step away from 0 and 1, where the logarithms would be infinite.
        u = torch.rand(num_nodes, generator=generator).double() + 2.0**-25
        return (torch.log(u) - torch.log1p(-u)).float()

    def sample(self, logits: torch.Tensor, noise: torch.Tensor | None) -> torch.Tensor:
        z = logits if noise is None else logits + noise.to(logits.dtype)
        soft = torch.sigmoid(z / self.config.temperature)
        return (z.detach() > 0).to(z.dtype) + (soft - soft.detach())

    def open_probability(self, logits: torch.Tensor) -> torch.Tensor:
        return torch.sigmoid(logits)

    def bound(self, logits: torch.Tensor) -> torch.Tensor:
        return logits.clamp(-self.config.bound, self.config.bound)
