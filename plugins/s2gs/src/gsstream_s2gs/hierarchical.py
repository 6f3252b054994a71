"""Hierarchical feature propagation: a tree is as suspect as its most suspect Gaussian."""

from __future__ import annotations

from typing import final

import torch
from pydantic import Field

from gsstream.api import Hierarchy, PartConfig, Propagation, ShapeError, Traits, check_finite, check_shape


@final
class HierarchicalMax(Propagation):
    """z_node = max of z_i over all Gaussians i of the node's tree (paper, equation for p_j, "HFP").

    The maximum of the whole tree is collected at its root and given back to every node of the tree, so that a region
    opens or closes as one. When every node is a root (the octree's default) this is the maximum over each group,
    exactly the paper's index map. The paper takes the maximum of probabilities; the sigmoid is monotone, so the
    maximum of logits is the same gate. Monotone, conservative, idempotent; trees do not see each other.

    At ties the gradient is shared equally between the tied Gaussians.
    """

    class Config(PartConfig):
        empty: float = Field(
            default=-50.0, ge=-1e4, le=1e4, description="logit of a tree without Gaussians, -1e4 to 1e4 (ours)"
        )

    traits = Traits(conservative=True, idempotent=True, differentiable=True, normalised=True, parent_bound=True)

    def propagate(self, logits: torch.Tensor, hierarchy: Hierarchy) -> torch.Tensor:
        """[N] logits -> [M] logits. Raises ShapeError for a wrong length, a value that is not finite, or a cycle."""
        check_shape("logits", logits, (hierarchy.num_gaussians,))
        check_finite("logits", logits)
        root = roots(hierarchy.parent)
        best = logits.new_full((hierarchy.num_nodes,), self.config.empty)
        best = best.scatter_reduce(0, root[hierarchy.node_of], logits, reduce="amax", include_self=False)
        return best[root]


def roots(parent: torch.Tensor) -> torch.Tensor:
    """[M] root of each node, by pointer jumping: log2(M) gathers instead of one per level. Raises for a cycle."""
    root = parent
    for _ in range(len(parent).bit_length()):
        root = root[root]
    # Checked at the end: a circle whose length is a power of two looks settled on the way.
    if torch.equal(parent[root], root):
        return root
    raise ShapeError(f"parent: expected every node to end at a root, got a cycle among {len(parent)} nodes")
