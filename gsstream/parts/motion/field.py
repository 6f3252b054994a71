"""A field of motion, whatever made it, said as the rigid motions of small cells: so any player can play it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from gsstream.core.changes import Groups, Motion, Scene, groups_for
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.parts.motion.groups import groups_of_rows


def approximate_by_cells(
    scene: Scene,
    rows: IntArray,
    shell: torch.Tensor,
    translation: FloatArray,
    rotation: FloatArray,
    side: float,
    step: float,
) -> Motion | None:
    """Return the rigid motions of small cells that come nearest to a field; None where no cell moves.

    A cell moves when at least half of its Gaussians may and none is in the shell: by the mean of their shifts and
    turns, about its own centre.

    Arguments:
        scene: decoded, as both ends have it.
        rows: [A] Gaussians that the field is of, ascending.
        shell: [N] bool, Gaussians of the shell behind the scene (``work.shell_rows``).
        translation: [A, 3] of their centres, scene units.
        rotation: [A, 3] axis * tan(angle / 2).
        side: of a cell, scene units; a float32.
        step: of quantisation, scene units.
    """
    groups = groups_for(scene, side, 1, regroup=True)
    place = groups.group_of[rows]
    hits = np.bincount(place, minlength=groups.count)
    able = np.flatnonzero(groups_of_rows(groups, rows, shell))
    values: FloatArray = np.concatenate([translation, rotation], 1).astype(np.float64)
    means = np.stack([np.bincount(place, values[:, i], groups.count) / np.maximum(hits, 1) for i in range(6)], 1)
    # Half a cell from its centre, a turn of one step moves a Gaussian by a step, too.
    return rounded_motion(groups, able, means[able], translation_step=step, rotation_step=step / side)


def rounded_motion(
    groups: Groups, able: IntArray, values: FloatArray, translation_step: float, rotation_step: float
) -> Motion | None:
    """Return the motion of the cells of a grid that is laid anew; None where every value is rounded to 0.

    Arguments:
        groups: of the grid, one per cell.
        able: [K] cells that may move, ascending.
        values: [K, 6] their translations, scene units, and rotations, axis * tan(angle / 2).
        translation_step, rotation_step: of quantisation, in these units.
    """
    steps = float(np.float32(translation_step)), float(np.float32(rotation_step))
    symbols = np.rint(values / np.repeat(steps, 3)).astype(np.int32)
    moved = symbols.any(1)
    if not moved.any():
        return None
    marks = np.zeros(groups.count, np.uint8)
    marks[able[moved]] = 1
    return Motion(groups.cell, 1, marks, symbols[moved], *steps, predicted=False, regroup=True)


def transform_rows(
    gaussians: Gaussians[torch.Tensor], translation: torch.Tensor, rotation: torch.Tensor
) -> Gaussians[torch.Tensor]:
    """Return Gaussians, raw values, each shifted [A, 3] and rotated [A, 3] about its centre, with a graph.

    ``translation`` is in scene units, ``rotation`` is axis * tan(angle / 2).
    """
    quat = torch.nn.functional.normalize(torch.cat([torch.ones_like(rotation[:, :1]), rotation], 1), dim=1)
    w0, x0, y0, z0 = quat.unbind(1)
    w1, x1, y1, z1 = gaussians.quats.unbind(1)
    quats = torch.stack(
        [
            w0 * w1 - x0 * x1 - y0 * y1 - z0 * z1,
            w0 * x1 + x0 * w1 + y0 * z1 - z0 * y1,
            w0 * y1 - x0 * z1 + y0 * w1 + z0 * x1,
            w0 * z1 + x0 * y1 - y0 * x1 + z0 * w1,
        ],
        1,
    )
    return replace(gaussians, means=gaussians.means + translation, quats=quats)
