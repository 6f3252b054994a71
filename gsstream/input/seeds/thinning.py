"""Thin a cloud: averages over voxels, finer where the colour varies. Deterministic."""

from __future__ import annotations

import numpy as np

from gsstream.core.errors import InputError
from gsstream.core.frame import PointCloud
from gsstream.core.shapes import FloatArray, IntArray, check_finite


def thin_points(cloud: PointCloud, max_points: int) -> PointCloud:
    """Return at most ``max_points`` points; the cloud itself when it is small enough.

    Points within a voxel become their mean. About half of the budget spreads evenly over space, the rest halves the
    voxels whose colours vary most, so that edges and texture keep more points than plain walls.
    Raises InputError when ``max_points`` < 1, ShapeError for a non-finite point.
    """
    if max_points < 1:
        raise InputError(f"thin_points: expected max_points >= 1, got {max_points}")
    if len(cloud) <= max_points:
        return cloud
    xyz, rgb = cell_means(detail_cells(cloud, max_points), cloud.xyz, cloud.rgb)
    return PointCloud(xyz, rgb, cloud.origin)


def detail_cells(cloud: PointCloud, max_cells: int) -> IntArray:
    """Return [P]: cell of each point, numbered from 0, at most ``max_cells`` (one per point when that fits)."""
    check_finite("points", cloud.xyz)
    if len(cloud) <= max_cells:
        return np.arange(len(cloud))
    low = cloud.xyz.min(axis=0).astype(np.float64)
    offset = cloud.xyz.astype(np.float64) - low
    side = _voxel_side(offset, max(1, max_cells // 2))
    cells = _voxels(offset, side)
    # Three halvings at most: below an eighth of the even spacing lies mostly noise.
    for _ in range(3):
        side *= 0.5
        cells = _split(cells, _voxels(offset, side), cloud.rgb, max_cells)
    return cells


def cell_means(cells: IntArray, *arrays: FloatArray) -> tuple[FloatArray, ...]:
    """Return the mean of [P, K] arrays over each cell, float32, cells in ascending order."""
    count = np.bincount(cells)
    means = []
    for array in arrays:
        sums = [np.bincount(cells, weights=array[:, k].astype(np.float64)) for k in range(array.shape[1])]
        means.append((np.stack(sums, axis=1) / count[:, None]).astype(np.float32))
    return tuple(means)


def _voxel_side(offset: FloatArray, budget: int) -> float:
    """Nearly the smallest voxel side with at most ``budget`` occupied voxels (bisection on a logarithm)."""
    # Slightly more than the extent, so that the far faces fall into the one voxel of the coarsest grid.
    high = max(float(offset.max()), 1e-9) * 1.001
    low = high * 2.0**-20
    for _ in range(16):
        middle = float(np.sqrt(low * high))
        if int(_voxels(offset, middle).max()) + 1 <= budget:
            high = middle
        else:
            low = middle
    return high


def _voxels(offset: FloatArray, side: float) -> IntArray:
    """[P] number of the occupied voxel each point lies in."""
    index = np.floor(offset / side).astype(np.int64)
    key = (index[:, 0] << 42) | (index[:, 1] << 21) | index[:, 2]
    return np.unique(key, return_inverse=True)[1].astype(np.int64)


def _split(cells: IntArray, finer: IntArray, rgb: FloatArray, max_cells: int) -> IntArray:
    """Replace cells by their finer parts, most varied colours first, while the budget lasts."""
    number = int(cells.max()) + 1
    pairs, part = np.unique(cells * (int(finer.max()) + 1) + finer, return_inverse=True)
    parts = np.bincount(pairs // (int(finer.max()) + 1), minlength=number)
    mean, square = cell_means(cells, rgb, rgb.astype(np.float64) ** 2)
    variance = (square - mean**2).sum(1)
    order = np.lexsort((np.arange(number), -variance))
    growth = np.cumsum(parts[order] - 1)
    chosen = np.zeros(number, bool)
    chosen[order[growth <= max_cells - number]] = True
    chosen &= parts > 1
    mixed = np.where(chosen[cells], number + part, cells)
    return np.unique(mixed, return_inverse=True)[1].astype(np.int64)
