"""Always open: no sparsity."""

from __future__ import annotations

from typing import final

import torch

from gsstream.gate.base import GateSampler


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
