"""Saboteurs of the checks of structures."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch

from gsstream.core.hierarchy import Hierarchy
from gsstream.parts.structure.base import Anchors
from gsstream.testing.examples.structure import ExampleStructure
from saboteurs.register import spoils

Structure: Any = ExampleStructure
#: Size of the world "line", on which a few checks alone are made.
LINE = 20


@spoils("check_structure_partition")
class Barren(Structure):
    """A node without member or child."""

    def build(self, gaussians: Any, anchors: Anchors) -> Hierarchy:
        forest: Hierarchy = super().build(gaussians, anchors)
        if len(gaussians) != LINE:
            return forest
        index = torch.arange(forest.num_nodes + 1)
        return Hierarchy(forest.node_of, index, torch.zeros_like(index))


@spoils("check_structure_forest")
class Deep(Structure):
    """Roots that say they are on level 1."""

    def build(self, gaussians: Any, anchors: Anchors) -> Hierarchy:
        forest: Hierarchy = super().build(gaussians, anchors)
        return replace(forest, level=forest.level + (len(gaussians) == LINE))


@spoils("check_structure_label_free")
class FirstComeFirst(Structure):
    """Takes one Gaussian out of the largest node when the first row lies to the right of the last."""

    def build(self, gaussians: Any, anchors: Anchors) -> Hierarchy:
        forest: Hierarchy = super().build(gaussians, anchors)
        x = gaussians.means[:, 0].detach()
        if len(x) < 100 or float(x[0]) <= float(x[-1]):
            return forest
        node_of = forest.node_of.clone()
        node_of[(node_of == torch.bincount(node_of).argmax()).nonzero()[0]] = forest.num_nodes
        index = torch.arange(forest.num_nodes + 1)
        return Hierarchy(node_of, index, torch.zeros_like(index))


@spoils("check_structure_locality")
class Wide(Structure):
    """Cells three times as wide as it says."""

    def build(self, gaussians: Any, anchors: Anchors) -> Hierarchy:
        wide = 3 if len(gaussians) == LINE else 1
        forest: Hierarchy = super().build(gaussians, replace(anchors, cell_sizes=wide * anchors.cell_sizes))
        return forest


@spoils("check_structure_idempotent")
class Reversed(Structure):
    """Numbers nodes by their last occurrence, so storing Gaussians node by node renames them."""

    def build(self, gaussians: Any, anchors: Anchors) -> Hierarchy:
        forest: Hierarchy = super().build(gaussians, anchors)
        last = torch.zeros(forest.num_nodes, dtype=torch.int64)
        last = last.scatter_reduce(0, forest.node_of, torch.arange(len(gaussians)), reduce="amax")
        rank = torch.argsort(torch.argsort(last, descending=True))
        return replace(forest, node_of=rank[forest.node_of])


@spoils("check_structure_degenerate")
class Crowded(Structure):
    """A root on level 1 when all Gaussians coincide."""

    def build(self, gaussians: Any, anchors: Anchors) -> Hierarchy:
        forest: Hierarchy = super().build(gaussians, anchors)
        crowd = len(gaussians) > 2 and bool((gaussians.means == gaussians.means[:1]).all())
        return replace(forest, level=forest.level + crowd)


@spoils("check_structure_no_gradient")
class Attached(Structure):
    """Levels that hang on the graph of the means."""

    def build(self, gaussians: Any, anchors: Anchors) -> Hierarchy:
        forest: Hierarchy = super().build(gaussians, anchors)
        if not gaussians.means.requires_grad:
            return forest
        return replace(forest, level=forest.level + 0.0 * gaussians.means.sum())


@spoils("check_structure_seed")
class Growing(Structure):
    """Cells that grow from level to level."""

    def seed(self, points: Any, cameras: Any) -> Anchors:
        anchors: Anchors = super().seed(points, cameras)
        return replace(anchors, cell_sizes=torch.cat([anchors.cell_sizes, 2 * anchors.cell_sizes]))


@spoils("check_structure_translation")
class Floating(Structure):
    """The grid begins at a third of the farthest coordinate."""

    def build(self, gaussians: Any, anchors: Anchors) -> Hierarchy:
        shift = 0.0
        if len(gaussians) > 100 and bool((anchors.origin == -2.0).all()):
            shift = 0.3 * float(gaussians.means.detach().abs().max())
        forest: Hierarchy = super().build(gaussians, replace(anchors, origin=anchors.origin + shift))
        return forest
