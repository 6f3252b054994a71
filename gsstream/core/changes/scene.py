"""Scene: the state that the changes of a frame apply to, all that a player keeps from earlier frames."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Groups:
    """Which group each row belongs to.

    Arguments:
        cell: side of a cell, scene units; rows of one cell and one shade are a group.
        brightness_bins: number of classes of brightness, 1 to 16.
        group_of: [N] int32 group of each row.
        count: G, the number of groups; some may have lost all their rows since.
    """

    cell: float
    brightness_bins: int
    group_of: IntArray
    count: int

    def gathered(self, source: IntArray) -> Groups | None:
        """Return the groups of the rows afterwards; an added Gaussian joins the group of the row stored before it.

        Without any row that was there before, there is nothing to join: None.
        """
        old = source < len(self.group_of)
        if not bool(old.any()):
            return None
        before = np.maximum.accumulate(np.where(old, np.arange(len(source)), -1))
        before[before < 0] = int(np.argmax(old))
        return replace(self, group_of=self.group_of[source[before]])


if TYPE_CHECKING:
    from gsstream.core.changes.history import Displacement
    from gsstream.core.changes.scene import Groups


@dataclass(frozen=True, slots=True)
class Layout:
    """How Gaussians are stored, known to both ends; between two key packets only added and removed Gaussians change it.

    Arguments:
        node_counts: [M] int32, number of Gaussians of each node; Gaussians are stored node by node.
        unit_of: [N] uint8, which of ``units`` each Gaussian has.
        units: [H] float32 > 0, scene units; a position residual is measured in the unit of its Gaussian.
    """

    node_counts: IntArray
    unit_of: IntArray
    units: FloatArray

    @staticmethod
    def flat(number: int, unit: float) -> Layout:
        """Return the layout in which each of ``number`` Gaussians is a node of its own, with one unit for all.

        Arguments:
            number: N.
            unit: above 0, scene units.
        """
        return Layout(np.ones(number, np.int32), np.zeros(number, np.uint8), np.array([unit], np.float32))

    def units_of(self, rows: IntArray) -> FloatArray:
        """Return the unit [A] float32 of each of the Gaussians ``rows`` [A]."""
        return np.asarray(self.units, np.float32).take(self.unit_of.take(rows))

    @property
    def node_of(self) -> IntArray:
        """[N] int64 node of each Gaussian."""
        return np.repeat(np.arange(len(self.node_counts), dtype=np.int64), self.node_counts)


@dataclass(frozen=True, slots=True)
class Scene:
    """The state that a delta turns into the next one.

    Arguments:
        gaussians: N rows, raw values, float32.
        layout: nodes and units of the rows.
        displacement: how far rows were displaced by the last frame; None: nothing moved, or a key packet came last.
        groups: the groups of the last motion; None until there is a motion after the last key packet.
        heading: where packets were empty, how far rows will have gone from this scene by the next frame if they go on
            as they did; no motion is predicted from it. None: as ``displacement`` says.
    """

    gaussians: Gaussians[FloatArray]
    layout: Layout
    displacement: Displacement | None = None
    groups: Groups | None = None
    heading: Displacement | None = None

    @property
    def ahead(self) -> Displacement | None:
        """How far rows will have gone by the next frame if they go on as they did; None: as far as known, nowhere."""
        return self.displacement if self.heading is None else self.heading
