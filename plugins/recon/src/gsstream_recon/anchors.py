"""Anchors: Gaussians that are drawn on several levels, so that they lie densely where Gaussians do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gsstream.api import Delta, FloatArray, IntArray, Layout
from gsstream.blocks import gather_rows, k_nearest, nearest_rows

#: Added to distances before they are inverted, as a share of their mean: an anchor may lie where an old one lay.
NEAR = 1e-3


@dataclass(frozen=True)
class AnchorLevels:
    """The Gaussians that are anchors: ``drawn`` for which frame, ``rows`` of each level, the coarsest first."""

    drawn: int
    rows: tuple[IntArray, ...]


class Level(NamedTuple):
    """Anchors of one level that some cell follows: ``at`` [K, 3] where they are, ``of`` [C] which each cell follows."""

    at: FloatArray
    of: IntArray

    def mean(self, values: FloatArray) -> FloatArray:
        """Return [K, 6]: the mean over the cells of each anchor of values [C, 6] of cells."""
        return self.sum(values) / np.bincount(self.of, minlength=len(self.at))[:, None]

    def sum(self, values: FloatArray) -> FloatArray:
        """Return [K, 6]: the sum over the cells of each anchor of values [C, 6] of cells."""
        return np.stack([np.bincount(self.of, column, len(self.at)) for column in values.T], 1)


def followed(anchors: AnchorLevels, before: Layout, delta: Delta) -> AnchorLevels:
    """Return the same anchors as rows of the scene after a packet, without those whose Gaussian left."""
    if not delta.has_row_edit:
        return anchors
    source = gather_rows(before.node_of, delta.added, delta.removed)
    place = np.full(int(before.node_counts.sum()), -1, np.int64)
    stayed = np.flatnonzero(source < len(place))
    place[source[stayed]] = stayed
    return AnchorLevels(anchors.drawn, tuple(place[rows][place[rows] >= 0] for rows in anchors.rows))


def bound(centres: FloatArray, means: FloatArray, anchors: AnchorLevels) -> list[Level]:
    """Return the levels, the coarsest first: each cell follows the nearest anchor of each."""
    levels = []
    for rows in anchors.rows:
        at = means[rows].astype(np.float64)
        kept, of = np.unique(nearest_rows(centres, at)[1], return_inverse=True)
        levels.append(Level(at[kept], of))
    return levels


def inherited(past: FloatArray, old: list[Level], new: list[Level], neighbours: int) -> list[FloatArray]:
    """Return the motions [K, 6] of the anchors on every level of ``new`` that give cells their past motion.

    The coarsest level stores the mean motion of its cells, each finer level the mean of what the coarser levels do not
    explain. An anchor that was drawn
    anew takes the mean of the nearest old ones of its level, weighed by one over the distance.
    """
    motions, left = [], past
    for before, now in zip(old, new, strict=True):
        motion = before.mean(left)
        left = left - motion[before.of]
        if old is not new:
            distance, near = k_nearest(now.at, before.at, min(neighbours, len(before.at)))
            weight = 1 / (distance + NEAR * distance.mean() + 1e-12)
            motion = (motion[near] * (weight / weight.sum(1, keepdims=True))[..., None]).sum(1)
        motions.append(motion)
    return motions
