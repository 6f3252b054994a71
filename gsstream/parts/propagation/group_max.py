"""Group maximum: a node has the highest confidence of its Gaussians."""

from __future__ import annotations

from typing import final

import torch

from gsstream.core.hierarchy import Hierarchy
from gsstream.core.shapes import check_finite
from gsstream.parts.propagation.base import Propagation, PropagationTraits

#: Logit of a node without members.
EMPTY = -50.0


@final
class GroupMax(Propagation):
    """Maximum over each node's own members; on the flat structure the identity."""

    source = "gsstream"

    traits = PropagationTraits(conservative=True, idempotent=True, differentiable=True, normalised=True)

    def propagate(self, logits: torch.Tensor, hierarchy: Hierarchy) -> torch.Tensor:
        check_finite("logits", logits)
        start = logits.new_full((hierarchy.num_nodes,), EMPTY)
        return start.scatter_reduce(0, hierarchy.node_of, logits, reduce="amax", include_self=False)
