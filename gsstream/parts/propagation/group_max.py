"""Group maximum: a node has the highest confidence of its Gaussians."""

from __future__ import annotations

from typing import final

import torch
from pydantic import Field

from gsstream.core.hierarchy import Hierarchy
from gsstream.core.part import PartConfig
from gsstream.core.shapes import check_finite
from gsstream.parts.propagation.base import Propagation, PropagationTraits


@final
class GroupMax(Propagation):
    """Maximum over each node's own members; on the flat structure the identity."""

    source = "gsstream"

    class Config(PartConfig):
        empty: float = Field(default=-50.0, description="logit of a node without members")

    traits = PropagationTraits(conservative=True, idempotent=True, differentiable=True, normalised=True)

    def propagate(self, logits: torch.Tensor, hierarchy: Hierarchy) -> torch.Tensor:
        check_finite("logits", logits)
        start = logits.new_full((hierarchy.num_nodes,), self.config.empty)
        return start.scatter_reduce(0, hierarchy.node_of, logits, reduce="amax", include_self=False)
