"""Hierarchy: which node each Gaussian belongs to, and each node's parent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from gsstream.core.errors import ShapeError

if TYPE_CHECKING:
    import torch


@dataclass(frozen=True, slots=True)
class Hierarchy:
    """A forest over N Gaussians.

    Arguments:
        node_of: [N] int64, node of each Gaussian, in [0, M).
        parent: [M] int64; a root is its own parent, so no -1 exists and every gather is total.
        level: [M] int64; 0 at a root, one more than the parent elsewhere.
    """

    node_of: torch.Tensor
    parent: torch.Tensor
    level: torch.Tensor

    @property
    def num_nodes(self) -> int:
        return int(self.parent.shape[0])

    @property
    def num_gaussians(self) -> int:
        return int(self.node_of.shape[0])

    def to(self, device: torch.device) -> Hierarchy:
        """Return the same forest on a device."""
        return Hierarchy(self.node_of.to(device), self.parent.to(device), self.level.to(device))

    def rows(self, index: Any) -> Hierarchy:
        """Return the same forest seen by a subset of the Gaussians."""
        return Hierarchy(self.node_of[index], self.parent, self.level)

    def validate(self) -> None:
        """Raise ShapeError when the forest is not one."""
        m = self.num_nodes
        if tuple(self.level.shape) != (m,):
            raise ShapeError(f"level: expected shape [{m}] like parent, got {list(self.level.shape)}")
        if self.num_gaussians and (int(self.node_of.min()) < 0 or int(self.node_of.max()) >= m):
            got = f"{int(self.node_of.min())} to {int(self.node_of.max())}"
            raise ShapeError(f"node_of: expected values in [0, {m}), got {got}")
        if m == 0:
            return
        if int(self.parent.min()) < 0 or int(self.parent.max()) >= m:
            raise ShapeError(f"parent: expected values in [0, {m})")
        root = self.parent == _arange_like(self.parent)
        if bool((self.level[root] != 0).any()):
            raise ShapeError("level: expected 0 at every root (a node that is its own parent)")
        if bool((self.level[~root] != self.level[self.parent[~root]] + 1).any()):
            raise ShapeError("level: expected one more than the parent's level at every node that is not a root")


def tree_roots(parent: torch.Tensor) -> torch.Tensor:
    """Return [M]: the root of each node.

    Pointer jumping takes log2(depth) gathers instead of one per level.

    Raises:
        ShapeError: some node ends in a circle instead of at a root.
    """
    root = parent
    for _ in range(len(parent).bit_length()):
        further = root[root]
        if bool((further == root).all()):  # all nodes have reached their root
            break
        root = further
    # Checked at the end, because a circle whose length is a power of two looks like a root in between.
    if bool((parent[root] == root).all()):
        return root
    raise ShapeError(f"parent: expected every node to end at a root, got a cycle among {len(parent)} nodes")


def tree_max(values: torch.Tensor, hierarchy: Hierarchy, empty: float) -> torch.Tensor:
    """Return [M]: the largest value in each node's whole tree, the same for every node of a tree.

    Differentiable; at ties the gradient is shared equally between the tied members.

    Arguments:
        values: [N] one for each Gaussian.
        hierarchy: M nodes and the node of each Gaussian.
        empty: value of a tree without members.

    Raises:
        ShapeError: some node ends in a circle instead of at a root.
    """
    root = tree_roots(hierarchy.parent)
    best = values.new_full((hierarchy.num_nodes,), empty)
    best = best.scatter_reduce(0, root[hierarchy.node_of], values, reduce="amax", include_self=False)
    return best[root]


def _arange_like(index: torch.Tensor) -> torch.Tensor:
    import torch

    return torch.arange(index.shape[0], device=index.device, dtype=index.dtype)
