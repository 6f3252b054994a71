"""Saboteurs of the checks of propagations. In the test forest only children have members: roots are inner nodes."""

from __future__ import annotations

from typing import Any

import torch

from gsstream.core.hierarchy import Hierarchy, tree_roots
from gsstream.testing.examples.propagation import ExamplePropagation
from saboteurs.register import spoils

Propagation: Any = ExamplePropagation


def _inner(hierarchy: Hierarchy) -> torch.Tensor:
    """[M] bool: nodes without members."""
    inner = torch.ones_like(hierarchy.parent, dtype=torch.bool)
    inner[hierarchy.node_of] = False
    return inner


def _tree_mean(logits: torch.Tensor, hierarchy: Hierarchy) -> torch.Tensor:
    """[M] mean over the members of each node's tree."""
    root = tree_roots(hierarchy.parent)
    start = logits.new_zeros(hierarchy.num_nodes)
    return start.scatter_reduce(0, root[hierarchy.node_of], logits, reduce="mean", include_self=False)[root]


@spoils("check_propagation_range")
class Inventor(Propagation):
    """More suspicion than came in, for very large logits."""

    def propagate(self, logits: torch.Tensor, hierarchy: Hierarchy) -> torch.Tensor:
        spread: torch.Tensor = super().propagate(logits, hierarchy)
        return spread + (spread > 1e3)


@spoils("check_propagation_normalised")
class Shrinking(Propagation):
    """A constant below 0 comes out lower."""

    def propagate(self, logits: torch.Tensor, hierarchy: Hierarchy) -> torch.Tensor:
        spread: torch.Tensor = super().propagate(logits, hierarchy)
        constant = len(logits) > 2 and bool((logits == logits[0]).all() & (logits[0] < 0))
        return spread - 0.5 * constant


@spoils("check_propagation_flat_identity")
class Damped(Propagation):
    """Loses a tenth where every Gaussian is a node of its own."""

    def propagate(self, logits: torch.Tensor, hierarchy: Hierarchy) -> torch.Tensor:
        spread: torch.Tensor = super().propagate(logits, hierarchy)
        return 0.9 * spread if 12 < hierarchy.num_nodes == hierarchy.num_gaussians else spread


@spoils("check_propagation_relabelling")
class ParentsFirst(Propagation):
    """Takes for granted that parents are numbered before their children."""

    def propagate(self, logits: torch.Tensor, hierarchy: Hierarchy) -> torch.Tensor:
        index = torch.arange(hierarchy.num_nodes, device=logits.device)
        parent = torch.where(hierarchy.parent > index, index, hierarchy.parent)
        spread: torch.Tensor = super().propagate(logits, Hierarchy(hierarchy.node_of, parent, hierarchy.level))
        return spread


@spoils("check_propagation_monotone")
class Contrast(Propagation):
    """Inner nodes rise with the contrast inside their tree, and fall when the least suspect members rise."""

    def propagate(self, logits: torch.Tensor, hierarchy: Hierarchy) -> torch.Tensor:
        spread: torch.Tensor = super().propagate(logits, hierarchy)
        contrast = 2 * (spread - _tree_mean(logits, hierarchy))
        return torch.where(_inner(hierarchy), spread + contrast, spread)


@spoils("check_propagation_conservative")
class Average(Propagation):
    """The mean of the tree instead of its maximum: weak suspects drown."""

    def propagate(self, logits: torch.Tensor, hierarchy: Hierarchy) -> torch.Tensor:
        super().propagate(logits, hierarchy)
        return _tree_mean(logits, hierarchy)


@spoils("check_propagation_tree_local")
class Gossip(Propagation):
    """Inner nodes hear of the most suspect Gaussian of the whole scene."""

    def propagate(self, logits: torch.Tensor, hierarchy: Hierarchy) -> torch.Tensor:
        spread: torch.Tensor = super().propagate(logits, hierarchy)
        if len(logits) == 0:
            return spread
        return torch.where(_inner(hierarchy), spread + 0.01 * (logits.max() - spread), spread)


@spoils("check_propagation_idempotent")
class Halfway(Propagation):
    """A child takes the mean of its own maximum and its tree's, and moves on with every pass."""

    def propagate(self, logits: torch.Tensor, hierarchy: Hierarchy) -> torch.Tensor:
        spread: torch.Tensor = super().propagate(logits, hierarchy)
        own = torch.zeros_like(spread).scatter_reduce(0, hierarchy.node_of, logits, reduce="amax", include_self=False)
        return (torch.where(_inner(hierarchy), spread, own) + spread) / 2


@spoils("check_propagation_parent_bound")
class ModestParents(Propagation):
    """Inner nodes are less suspect than their children."""

    def propagate(self, logits: torch.Tensor, hierarchy: Hierarchy) -> torch.Tensor:
        spread: torch.Tensor = super().propagate(logits, hierarchy)
        return spread - _inner(hierarchy).to(spread.dtype)


@spoils("check_propagation_gradient")
class Severed(Propagation):
    """Says that it is differentiable and cuts the graph."""

    def propagate(self, logits: torch.Tensor, hierarchy: Hierarchy) -> torch.Tensor:
        spread: torch.Tensor = super().propagate(logits, hierarchy)
        return spread.detach()
