"""A field of motion, whatever made it, said as the rigid motions of small cells: so any player can play it."""

from __future__ import annotations

import numpy as np

from gsstream.core.changes import Motion, Scene, groups_for
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.parts.motion.groups import groups_of_rows


def approximate_by_cells(
    scene: Scene, rows: IntArray, translation: FloatArray, rotation: FloatArray, side: float, step: float
) -> Motion | None:
    """Return the rigid motions of small cells that come nearest to a field; None where no cell moves.

    A cell moves when at least half of its Gaussians may: by the mean of their shifts and turns, about its own centre.

    Arguments:
        scene: decoded, as both ends have it.
        rows: [A] Gaussians that the field is of, ascending.
        translation: [A, 3] of their centres, scene units.
        rotation: [A, 3] axis * tan(angle / 2).
        side: of a cell, scene units; a float32.
        step: of quantisation, scene units.
    """
    groups = groups_for(scene, side, 1, regroup=True)
    place = groups.group_of[rows]
    hits = np.bincount(place, minlength=groups.count)
    able = np.flatnonzero(groups_of_rows(groups, rows))
    values: FloatArray = np.concatenate([translation, rotation], 1).astype(np.float64)
    means = np.stack([np.bincount(place, values[:, i], groups.count) / np.maximum(hits, 1) for i in range(6)], 1)
    # Half a cell from its centre, a turn of one step moves a Gaussian by a step, too.
    steps = float(np.float32(step)), float(np.float32(step / side))
    symbols = np.rint(means[able] / np.array([steps[0]] * 3 + [steps[1]] * 3)).astype(np.int32)
    moved = symbols.any(1)
    if not moved.any():
        return None
    marks = np.zeros(groups.count, np.uint8)
    marks[able[moved]] = 1
    return Motion(side, 1, marks, symbols[moved], *steps, predicted=False, regroup=True)
