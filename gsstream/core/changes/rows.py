"""Rows: Gaussians that a frame adds and removes, and what becomes of rows and layout then.

Rows stay stored node by node: a Gaussian is added behind the last row of its node. Old rows keep their order, and nodes
keep their numbers: a node may become empty, a new one comes behind the old ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from gsstream.core.changes.scene import Layout, Scene
from gsstream.core.errors import ShapeError
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray, IntArray

Table = TypeVar("Table", FloatArray, IntArray)


@dataclass(frozen=True, slots=True)
class AddedGaussians:
    """B Gaussians that one frame adds, and K nodes that come with them.

    Arguments:
        gaussians: B rows, raw values.
        nodes: [B] int64 node of each, ascending; M to M + K - 1 are the new ones.
        unit_of: [B] uint8, which of the layout's units each Gaussian has.
        parents: [K] int64 parent of each new node, a node with a smaller number; its own number: a root.
    """

    gaussians: Gaussians[FloatArray]
    nodes: IntArray
    unit_of: IntArray
    parents: IntArray

    def __len__(self) -> int:
        return len(self.nodes)


@dataclass(frozen=True, slots=True)
class RowEdit:
    """Rows that leave, then rows that join.

    Arguments:
        added: Gaussians added, or None.
        removed: [D] int64 rows removed (of the scene before the added Gaussians), ascending.
    """

    added: AddedGaussians | None = None
    removed: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))

    @property
    def is_empty(self) -> bool:
        """Whether no row leaves and none joins."""
        return self.added is None and len(self.removed) == 0


def apply_row_edit(scene: Scene, rows: RowEdit) -> Scene:
    """Return the scene without the rows that leave and with those that join. Raises ShapeError when they do not fit.

    An added Gaussian belongs to the group of the row stored before it, so that it moves with its neighbours.
    """
    layout, added = scene.layout, rows.added
    check_removed(rows.removed, len(layout.unit_of))
    if rows.is_empty:
        return scene
    if added is not None:
        widths = [(name, int(np.prod(value.shape[1:]))) for name, value in scene.gaussians.items()]
        check_added(added, len(layout.node_counts), len(layout.units), widths)
    source = gather_rows(layout.node_of, added, rows.removed)
    gaussians = Gaussians(
        **{
            name: join_rows(value, None if added is None else getattr(added.gaussians, name), source)
            for name, value in scene.gaussians.items()
        }
    )
    units = join_rows(layout.unit_of, None if added is None else added.unit_of, source).astype(np.uint8)
    counts = edited_counts(layout.node_counts, layout.node_of, added, rows.removed)
    displacement = None if scene.displacement is None else scene.displacement.gathered(source)
    groups = None if scene.groups is None else scene.groups.gathered(source)
    return Scene(gaussians, Layout(counts, units, layout.units), displacement, groups)


def add_as_nodes(gaussians: Gaussians[FloatArray], unit_of: IntArray, num_nodes: int) -> AddedGaussians:
    """Return Gaussians to add, each with a root node of their own, so that each has a gate of its own.

    Arguments:
        gaussians: B rows, raw values.
        unit_of: [B] uint8, which of the layout's units each has.
        num_nodes: M, nodes before the added Gaussians.
    """
    nodes = num_nodes + np.arange(len(gaussians), dtype=np.int64)
    return AddedGaussians(gaussians, nodes, np.asarray(unit_of, np.uint8), nodes)


def add_to_nodes(gaussians: Gaussians[FloatArray], nodes: IntArray, unit_of: IntArray) -> AddedGaussians:
    """Return added Gaussians into existing nodes; a copy stays in the node of what it was copied from.

    Arguments:
        gaussians: B rows, raw values, in any order.
        nodes: [B] int64 node of each, 0 to M - 1.
        unit_of: [B] uint8, which of the layout's units each has.
    """
    order = np.argsort(nodes, kind="stable")
    units = np.asarray(unit_of, np.uint8)[order]
    return AddedGaussians(gaussians.rows(order), np.asarray(nodes, np.int64)[order], units, np.zeros(0, np.int64))


def gather_rows(node_of: IntArray, added: AddedGaussians | None, removed: IntArray) -> IntArray:
    """Return [N'] int64: which row each row of the scene afterwards was before; N + j is added row j.

    Arguments:
        node_of: [N] node of each row before, ascending.
        added: rows that join, or None.
        removed: [D] rows that leave, ascending.
    """
    kept = np.delete(np.arange(len(node_of), dtype=np.int64), removed)
    if added is None or not len(added):
        return kept
    places = np.searchsorted(node_of[kept], added.nodes, side="right")
    return np.asarray(np.insert(kept, places, len(node_of) + np.arange(len(added))))


def edited_counts(
    node_counts: IntArray, node_of: IntArray, added: AddedGaussians | None, removed: IntArray
) -> IntArray:
    """Return [M + K] int32: Gaussians of each of M nodes, and of K new ones, after rows were added and removed."""
    counts = np.asarray(node_counts, np.int64) - np.bincount(node_of[removed], minlength=len(node_counts))
    if added is not None:
        counts = np.concatenate([counts, np.zeros(len(added.parents), np.int64)])
        counts += np.bincount(added.nodes, minlength=len(counts))
    return counts.astype(np.int32)


def join_rows(old: Table, added: Table | None, source: IntArray) -> Table:
    """Return an attribute's rows after old ones were chosen (``source``: :func:`gather_rows`) and others added."""
    joined: Table = (old if added is None else np.concatenate([old, added]))[source]
    return joined


def check_added(added: AddedGaussians, num_nodes: int, num_units: int, shapes: Sequence[tuple[str, int]]) -> None:
    """Raise ShapeError unless the added Gaussians fit a scene of so many nodes, units and values per attribute."""
    number, new = len(added.nodes), len(added.parents)
    if len(added.gaussians) != number or len(added.unit_of) != number:
        raise ShapeError(
            f"added: expected {number} Gaussians and units like nodes, got {len(added.gaussians)} and "
            f"{len(added.unit_of)}"
        )
    nodes = np.asarray(added.nodes)
    if number and (int(nodes[0]) < 0 or int(nodes[-1]) >= num_nodes + new or np.any(np.diff(nodes) < 0)):
        raise ShapeError(f"added: expected nodes from 0 to {num_nodes + new - 1}, ascending")
    own = num_nodes + np.arange(new)
    if np.any(added.parents < 0) or np.any(added.parents > own):
        raise ShapeError("added: expected for every new node a parent with a smaller number, or its own (a root)")
    if number and int(np.max(added.unit_of)) >= num_units:
        raise ShapeError(f"added: expected units 0 to {num_units - 1}, got {int(np.max(added.unit_of))}")
    for name, width in shapes:
        got = int(np.prod(getattr(added.gaussians, name).shape[1:]))
        if got != width:
            raise ShapeError(f"added: expected {width} values of {name} like the scene, got {got}")


def check_removed(removed: IntArray, number: int) -> None:
    """Raise ShapeError unless ``removed`` are rows of N Gaussians, ascending, none twice."""
    if len(removed) and (int(removed[0]) < 0 or int(removed[-1]) >= number or np.any(np.diff(removed) <= 0)):
        raise ShapeError(f"removed: expected rows from 0 to {number - 1}, ascending and none twice")
