"""Hierarchical feature propagation: a tree has the highest confidence of its Gaussians."""

from __future__ import annotations

from typing import final

import torch

from gsstream.api import Hierarchy, Propagation, PropagationTraits, check_finite, check_shape, tree_max

#: Logit of a tree without Gaussians.
EMPTY = -50.0


@final
class HierarchicalMax(Propagation):
    """z_node = max of z_i over all Gaussians i of the node's tree (paper, equation for p_j, "HFP").

    The maximum of the whole tree is collected at its root and given back to every node of the tree, so that a region
    opens or closes as one. When every node is a root (the octree's default) this is the maximum over each group,
    exactly the paper's index map. The paper takes the maximum of probabilities; the sigmoid is monotone, so the
    maximum of logits is the same gate. Monotone, conservative, idempotent; trees do not see each other.

    At ties the gradient is shared equally between the tied Gaussians.
    """

    source = 'S2GS, equation for p_j ("HFP")'

    traits = PropagationTraits(
        conservative=True, idempotent=True, differentiable=True, normalised=True, parent_bound=True
    )

    def propagate(self, logits: torch.Tensor, hierarchy: Hierarchy) -> torch.Tensor:
        """[N] logits -> [M] logits. Raises ShapeError for a wrong length, a value that is not finite, or a cycle."""
        check_shape("logits", logits, (hierarchy.num_gaussians,))
        check_finite("logits", logits)
        return tree_max(logits, hierarchy, EMPTY)
