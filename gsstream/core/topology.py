"""TopologyEdit: one gather map expresses duplicate, split, remove, relocate and permute."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True, slots=True)
class TopologyEdit:
    """New row i of N' copies old row ``source[i]`` (int64); where ``fresh[i]`` its optimiser moments start at zero."""

    source: torch.Tensor
    fresh: torch.Tensor

    @staticmethod
    def permute(order: torch.Tensor) -> TopologyEdit:
        """Reorder rows: new row i is old row ``order[i]``."""
        import torch

        return TopologyEdit(order, torch.zeros(order.shape[0], dtype=torch.bool))
