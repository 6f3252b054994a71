"""Adam's moments of one table, row by row, and its constants."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import torch

ADAM_BETAS = (0.9, 0.999)
ADAM_EPS = 1e-15  # released code and 3DGS: tiny gradients of tiny Gaussians must still move them
#: Largest gradient that is taken. The square of a larger one leaves float32, its mean stays infinite, and the row would
#: never move again, without a message.
MAX_GRADIENT = 1e18


@dataclass(frozen=True, slots=True)
class AdamState:
    """Moments of one table of n rows; float32, contiguous.

    Arguments:
        exp_avg, exp_avg_sq: like the table, running means of the gradient and of its square.
        steps: [n] int32, updates that each row has taken. A row that joins later starts with zeros.
    """

    exp_avg: torch.Tensor
    exp_avg_sq: torch.Tensor
    steps: torch.Tensor

    @staticmethod
    def start(values: torch.Tensor) -> AdamState:
        """Return the state before any step, for a table ``values`` [n, ...]."""
        zeros = torch.zeros_like(values, requires_grad=False)
        return AdamState(zeros, zeros.clone(), torch.zeros(len(values), dtype=torch.int32, device=values.device))


class RowSteps(Protocol):
    """What makes Adam steps on tables by name: :class:`gsstream.parts.backend.row_optimiser.RowOptimiser`."""

    def step(
        self,
        values: Mapping[str, torch.Tensor],
        gradients: Mapping[str, torch.Tensor],
        states: Mapping[str, AdamState],
        lrs: Mapping[str, float | torch.Tensor],
    ) -> None: ...
