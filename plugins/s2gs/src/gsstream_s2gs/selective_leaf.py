"""Selective leaf-level gating: one decision per region while it acts as one, one per leaf where it does not."""

from __future__ import annotations

import math
from typing import final

import torch
from pydantic import Field

from gsstream.api import (
    Hierarchy,
    PartConfig,
    Propagation,
    PropagationTraits,
    ShapeError,
    check_finite,
    check_shape,
    tree_roots,
)


@final
class SelectiveLeaf(Propagation):
    """Shares one decision where a region is homogeneous and decides leaf by leaf elsewhere (the paper: future work).

    For a structure whose gates lie below the roots (``structure.gate_level`` 1 or more). A tree whose suspect nodes
    (logit above ``suspect``) are at least a share ``spread`` of its nodes with members moves as one: all its nodes get
    the maximum of the tree, as in ``hierarchical-max``. In any other tree each node gets the maximum of its own
    subtree: a still leaf beside a moving one stays closed. When every node is a root this is the maximum over each
    group.
    """

    source = 'gsstream, after future work named in S2GS ("Root-level Gating Strategy")'

    class Config(PartConfig):
        suspect: float = Field(
            default=1.0, ge=-50, le=50, description="logit above which a node counts as suspect, -50 to 50"
        )
        spread: float = Field(
            default=0.5, gt=0, le=1, description="share of suspect nodes from which a tree moves as one, 0 to 1"
        )
        empty: float = Field(
            default=-50.0, ge=-1e4, le=1e4, description="largest logit of a subtree without Gaussians, -1e4 to 1e4"
        )

    traits = PropagationTraits(
        conservative=True, idempotent=True, differentiable=True, normalised=True, parent_bound=True
    )

    def propagate(self, logits: torch.Tensor, hierarchy: Hierarchy) -> torch.Tensor:
        """[N] logits -> [M] logits. Raises ShapeError for a wrong length, a value that is not finite, or a cycle."""
        check_shape("logits", logits, (hierarchy.num_gaussians,))
        check_finite("logits", logits)
        root = tree_roots(hierarchy.parent)
        own = logits.new_full((hierarchy.num_nodes,), -math.inf)
        own = own.scatter_reduce(0, hierarchy.node_of, logits, reduce="amax", include_self=False)
        best = self._subtrees(own, hierarchy)
        owners = torch.zeros(hierarchy.num_nodes, dtype=torch.float64, device=logits.device)
        owners[hierarchy.node_of] = 1
        members = torch.zeros_like(owners).index_add(0, root, owners)
        suspects = torch.zeros_like(owners).index_add(0, root, owners * (own > self.config.suspect))
        as_one = suspects >= self.config.spread * members
        return torch.where(as_one[root], best[root], best)

    def _subtrees(self, own: torch.Tensor, hierarchy: Hierarchy) -> torch.Tensor:
        """[M] maximum over each node and all below it; without Gaussians at most the parent's."""
        best, deepest = own, int(hierarchy.level.max()) if hierarchy.num_nodes else 0
        for level in range(deepest, 0, -1):
            below = hierarchy.level == level
            best = best.scatter_reduce(0, hierarchy.parent[below], best[below], reduce="amax")
        if bool((best[hierarchy.parent] < best).any()):
            raise ShapeError("level: expected one more than the parent's level at every node that is not a root")
        without = best == -math.inf
        best = best.masked_fill(without, self.config.empty)
        for level in range(1, deepest + 1):
            at = without & (hierarchy.level == level)
            best = torch.where(at, torch.minimum(best, best[hierarchy.parent]), best)
        return best
