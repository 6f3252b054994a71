"""Selective leaf-level gating against a walk over the forest."""

from __future__ import annotations

import pytest
import torch
from gsstream_s2gs.hierarchical import HierarchicalMax
from gsstream_s2gs.selective_leaf import SelectiveLeaf
from hypothesis import given, settings
from hypothesis import strategies as st

from gsstream.api import Hierarchy, ShapeError


def forest(parents: list[int], node_of: list[int]) -> Hierarchy:
    """A forest from parents (a root is its own)."""
    depth = []
    for node in range(len(parents)):
        steps = 0
        while parents[node] != node:
            node, steps = parents[node], steps + 1
        depth.append(steps)
    return Hierarchy(torch.tensor(node_of), torch.tensor(parents), torch.tensor(depth))


def walked(logits: list[float], hierarchy: Hierarchy, suspect: float, spread: float, empty: float) -> list[float]:
    """The definition, node by node, in plain Python."""
    parents, node_of = hierarchy.parent.tolist(), hierarchy.node_of.tolist()

    def above(node: int) -> list[int]:
        chain = [node]
        while parents[chain[-1]] != chain[-1]:
            chain.append(parents[chain[-1]])
        return chain

    subtree = [max((z for z, n in zip(logits, node_of, strict=True) if j in above(n)), default=empty) for j in
               range(len(parents))]  # fmt: skip
    out = []
    for node in range(len(parents)):
        root = above(node)[-1]
        owners = {n for n in node_of if above(n)[-1] == root}
        loud = {n for n in owners if max(z for z, m in zip(logits, node_of, strict=True) if m == n) > suspect}
        out.append(subtree[root] if len(loud) >= spread * len(owners) else subtree[node])
    return out


def test_a_still_leaf_beside_a_moving_one_stays_closed() -> None:
    """Two regions of four leaves: in the first one leaf moves, in the second three do."""
    hierarchy = forest([0, 1, 0, 0, 0, 0, 1, 1, 1, 1], [2, 3, 4, 5, 6, 7, 8, 9])
    z = torch.tensor([5.0, -3.0, -3.0, -3.0, 4.0, 4.0, 4.0, -3.0])
    got = SelectiveLeaf().propagate(z, hierarchy)
    assert got.tolist() == [5.0, 4.0, 5.0, -3.0, -3.0, -3.0, 4.0, 4.0, 4.0, 4.0]
    assert HierarchicalMax().propagate(z, hierarchy).tolist() == [5.0, 4.0, 5.0, 5.0, 5.0, 5.0, 4.0, 4.0, 4.0, 4.0]


@settings(max_examples=100, deadline=None)
@given(
    data=st.data(), nodes=st.integers(1, 9), count=st.integers(0, 14), suspect=st.sampled_from([-1.5, 0.0, 1.0]),
    spread=st.sampled_from([0.01, 0.25, 0.5, 1.0]),
)  # fmt: skip
def test_against_the_walk(data: st.DataObject, nodes: int, count: int, suspect: float, spread: float) -> None:
    parents = [data.draw(st.integers(0, node)) for node in range(nodes)]
    node_of = data.draw(st.lists(st.integers(0, nodes - 1), min_size=count, max_size=count))
    logits = data.draw(st.lists(st.integers(-4, 4).map(float), min_size=count, max_size=count))
    hierarchy = forest(parents, node_of)
    hierarchy = Hierarchy(hierarchy.node_of.long(), hierarchy.parent, hierarchy.level)
    part = SelectiveLeaf(SelectiveLeaf.Config(suspect=suspect, spread=spread))
    got = part.propagate(torch.tensor(logits), hierarchy)
    assert got.tolist() == walked(logits, hierarchy, suspect, spread, part.config.empty)


def test_among_roots_it_is_the_maximum_of_each_group() -> None:
    hierarchy = forest([0, 1, 2], [0, 0, 1, 2, 2])
    z = torch.tensor([1.0, 2.0, -1.0, 0.5, 3.0])
    assert torch.equal(SelectiveLeaf().propagate(z, hierarchy), HierarchicalMax().propagate(z, hierarchy))


def test_levels_that_contradict_the_parents_are_refused() -> None:
    hierarchy = Hierarchy(torch.tensor([1]), torch.tensor([0, 0]), torch.tensor([0, 0]))
    with pytest.raises(ShapeError, match="level: expected one more"):
        SelectiveLeaf().propagate(torch.tensor([3.0]), hierarchy)
