"""TopologyEdit: one gather map expresses duplicate, split, remove, relocate and permute, and composes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    import torch

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class TopologyEdit:
    """New row i copies old row ``source[i]``; where ``fresh[i]`` its optimiser moments start at zero.

    Arguments:
        source: [N'] int64 rows of the old scene.
        fresh: [N'] bool.
    """

    source: torch.Tensor
    fresh: torch.Tensor

    @staticmethod
    def keep(mask: torch.Tensor) -> TopologyEdit:
        """Remove the rows where ``mask`` [N] is False."""
        source = mask.nonzero()[:, 0]
        return TopologyEdit(source, source.new_zeros(source.shape[0], dtype=mask.dtype))

    @staticmethod
    def permute(order: torch.Tensor) -> TopologyEdit:
        """Reorder rows: new row i is old row ``order[i]``."""
        import torch

        return TopologyEdit(order, torch.zeros(order.shape[0], dtype=torch.bool))

    def then(self, other: TopologyEdit) -> TopologyEdit:
        """The edit equal to this one followed by ``other``."""
        return TopologyEdit(self.source[other.source], self.fresh[other.source] | other.fresh)
