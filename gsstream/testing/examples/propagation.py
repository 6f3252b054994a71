"""Tree maximum: a tree has the highest confidence of its Gaussians."""

from __future__ import annotations

from typing import final

import torch
from pydantic import Field

from gsstream.api import Hierarchy, PartConfig, Propagation, PropagationTraits, check_finite, check_shape, tree_max


@final
class ExamplePropagation(Propagation):
    """Gives every node the largest logit of its tree: z_node = max of z_i."""

    source = "gsstream, after the propagation of S2GS"

    class Config(PartConfig):
        empty: float = Field(default=-50.0, ge=-1e4, le=0, description="logit of a tree without Gaussians")

    traits = PropagationTraits(
        conservative=True, idempotent=True, differentiable=True, normalised=True, parent_bound=True
    )

    def propagate(self, logits: torch.Tensor, hierarchy: Hierarchy) -> torch.Tensor:
        check_shape("logits", logits, (hierarchy.num_gaussians,))
        check_finite("logits", logits)
        return tree_max(logits, hierarchy, self.config.empty)
