"""Which groups a motion part works with: their size in pixels, and which of them lie in what changed."""

from __future__ import annotations

import numpy as np
import torch

from gsstream.core.cameras import Cameras
from gsstream.core.changes import Groups, Scene, groups_for
from gsstream.core.median import median
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.parts.render.work import FitContext


def pixel_size(means: FloatArray, cameras: Cameras) -> float:
    """Return how wide a pixel is at the scene's median distance from the cameras, scene units.

    Arguments:
        means: [N, 3] centres, N > 0.
    """
    columns = np.ascontiguousarray(means.T, np.float64)
    widths, x, y, z = np.empty((len(cameras), len(means))), *np.empty_like(columns)
    for width, at, K in zip(widths, cameras.centers, cameras.Ks, strict=True):
        for axis, (column, offset) in enumerate(zip((x, y, z), at, strict=True)):
            np.subtract(columns[axis], offset, out=column)
            np.multiply(column, column, out=column)
        np.add(np.add(x, y, out=x), z, out=x)
        np.divide(np.sqrt(x, out=x), K[0, 0], out=width)
    return float(median(widths))


def known_groups(scene: Scene, cameras: Cameras, pixels: float, brightness_bins: int) -> Groups:
    """Return the groups that the scene has had since the last key packet, else those of a grid.

    A cell that is known stays: it was measured on the scene of the last key packet, which a resumed run does not have.
    """
    if scene.groups is not None and scene.groups.brightness_bins == brightness_bins:
        return scene.groups
    cell = float(np.float32(max(pixels * pixel_size(scene.gaussians.means, cameras), 1e-6)))
    return groups_for(scene, cell, brightness_bins)


def changed_groups(groups: Groups, work: FitContext, votes: float, share: float) -> IntArray:
    """Return [G] bool: groups of which at least this share of the rows lie in what changed, and none in the shell."""
    changed = work.changed_rows(votes).cpu().numpy()
    total = np.bincount(groups.group_of, minlength=groups.count)
    hit = np.bincount(groups.group_of[changed], minlength=groups.count)
    return np.asarray((total > 0) & (hit > 0) & (hit >= share * total) & ~_groups_with(groups, work.shell_rows))


def groups_of_rows(groups: Groups, rows: IntArray, shell: torch.Tensor) -> IntArray:
    """Return [G] bool: groups that ``rows`` may move.

    At least half of their rows, and at least one, are among ``rows`` [A], and none is in the shell, ``shell`` [N] bool.
    """
    total = np.bincount(groups.group_of, minlength=groups.count)
    hit = np.bincount(groups.group_of[rows], minlength=groups.count)
    return np.asarray((hit > 0) & (2 * hit >= total) & ~_groups_with(groups, shell))


def _groups_with(groups: Groups, marked: torch.Tensor) -> IntArray:
    """[G] bool: groups that hold a marked row, [N] bool."""
    return np.asarray(np.bincount(groups.group_of[marked.cpu().numpy()], minlength=groups.count) > 0)
