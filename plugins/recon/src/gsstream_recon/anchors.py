"""Anchors: Gaussians that are drawn on several levels, so that they lie densely where Gaussians do."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gsstream.api import FloatArray, IntArray, PlayerState, Rng
from gsstream.blocks import gather_rows, k_nearest, nearest_rows
from gsstream_recon.settings import MotionSettings

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


def due(anchors: AnchorLevels | None, frame: int, number: int, settings: MotionSettings, rng: Rng) -> AnchorLevels:
    """Return the anchors of a frame: those of the frame before, or new ones when these are old or a level has none.

    Both ends could draw them: from the seed of the run and the number of the frame.
    """
    if anchors is not None and frame - anchors.drawn < settings.every and all(map(len, anchors.rows)):
        return anchors
    order = rng.numpy("recon/anchors", frame).permutation(number)
    sizes = [number / settings.per_anchor / settings.ratio**level for level in reversed(range(settings.levels))]
    return AnchorLevels(frame, tuple(np.sort(order[: max(1, round(size))]) for size in sizes))


def followed(anchors: AnchorLevels, player: PlayerState) -> AnchorLevels:
    """Return the same anchors as rows of the scene after a packet, without those whose Gaussian left."""
    if player.delta is None or player.before is None or not player.delta.has_row_edit:
        return anchors
    source = gather_rows(player.before.node_of, player.delta.added, player.delta.removed)
    place = np.full(int(player.before.node_counts.sum()), -1, np.int64)
    stayed = np.flatnonzero(source < len(place))
    place[source[stayed]] = stayed
    return AnchorLevels(anchors.drawn, tuple(place[rows][place[rows] >= 0] for rows in anchors.rows))


def anchors_after(players: Iterable[PlayerState], settings: MotionSettings, rng: Rng) -> AnchorLevels | None:
    """Return the anchors after the last of the packets since a key packet, which is the first; None without another."""
    anchors, number = None, 0
    for player in players:
        if player.delta is not None:
            anchors = followed(due(anchors, player.frame, number, settings, rng), player)
        number = len(player.gaussians)
    return anchors


def bound(centres: FloatArray, means: FloatArray, anchors: AnchorLevels) -> list[Level]:
    """Return the levels, the coarsest first: each cell follows the nearest anchor of each."""
    levels = []
    for rows in anchors.rows:
        at = means[rows].astype(np.float64)
        kept, of = np.unique(nearest_rows(centres, at)[1], return_inverse=True)
        levels.append(Level(at[kept], of))
    return levels


def inherited(past: FloatArray, old: list[Level], new: list[Level], neighbours: int) -> list[FloatArray]:
    """Return the motion [K, 6] of the anchors of every level of ``new`` that says the past motion of cells.

    The coarsest level says the mean of its cells, each finer one the mean of what is left. An anchor that was drawn
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
