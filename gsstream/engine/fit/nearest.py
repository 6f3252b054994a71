"""Nearest points in space, by a k-d tree: exact, and as long as the cloud in time and memory, not its square."""

from __future__ import annotations

import numpy as np
import torch

from gsstream.core.shapes import FloatArray, IntArray

#: Distance in scene units that is assumed for a point that has no neighbour.
ALONE = 0.01


def neighbour_distance(positions: torch.Tensor) -> torch.Tensor:
    """Return [N] float32: root mean squared distance to the three nearest other points, as in 3DGS.

    With fewer than three other points, the mean is over as many as there are.

    Points at one place are neighbours at distance 0. A point alone is taken to be 0.01 from another.

    Arguments:
        positions: [N, 3] finite, scene units.
    """
    count = len(positions)
    if count < 2:
        return torch.full((count,), ALONE)
    distances, _ = k_nearest(positions.numpy(), positions.numpy(), min(4, count))
    # The nearest is the point itself, or one at the same place.
    return torch.from_numpy(np.sqrt(np.square(distances[:, 1:]).mean(1)).astype(np.float32))


def nearest_rows(points: FloatArray, means: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return [B] the distance of each point to the nearest of ``means``, and its row; infinitely far without any."""
    if not len(means):
        return np.full(len(points), np.inf), np.zeros(len(points), np.int64)
    distances, rows = k_nearest(points, means, 1)
    return distances[:, 0], rows[:, 0]


def k_nearest(points: FloatArray, among: FloatArray, k: int) -> tuple[FloatArray, IntArray]:
    """Return the distances [B, k] of points to the ``k`` nearest of ``among``, nearest first, and their rows [B, k].

    Arguments:
        points: [B, 3]. among: [N, 3], N at least ``k``.
        k: 1 or more.
    """
    # Imported here because it takes 30 MB, which a process that only plays or resumes a stream does not need.
    from scipy.spatial import KDTree

    found: tuple[FloatArray, IntArray] = KDTree(among).query(points, k=np.arange(1, k + 1))
    return found
