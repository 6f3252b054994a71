"""Always open: no sparsity."""

from __future__ import annotations

import math
from typing import final

import torch

from gsstream.parts.gate.base import AnalyticGate, GateSampler

#: Logits that a sigmoid of float32 takes for infinity.
FAR = 100.0


@final
class AlwaysOpen(GateSampler):
    """Every gate is 1 and nothing is trained."""

    source = "gsstream"

    @property
    def num_levels(self) -> int:
        return 1

    def init(self, logits: torch.Tensor) -> torch.Tensor:
        return torch.zeros_like(logits)

    def noise(self, num_nodes: int, generator: torch.Generator) -> torch.Tensor | None:
        return None

    def sample(self, logits: torch.Tensor, noise: torch.Tensor | None) -> torch.Tensor:
        return torch.ones_like(logits)

    def open_probability(self, logits: torch.Tensor) -> torch.Tensor:
        return torch.ones_like(logits)

    def bound(self, logits: torch.Tensor) -> torch.Tensor:
        return logits

    def form(self) -> AnalyticGate:
        """Return a sigmoid so far up that it is 1 for every logit."""
        return AnalyticGate(temperature=1.0, levels=1, open_logit=-FAR, bound=math.inf, logit_offset=FAR)
