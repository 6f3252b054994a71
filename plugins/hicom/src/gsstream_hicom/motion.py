"""Hierarchical coherent motion: from coarse cells to fine ones, every grid on the scene that the last one left."""

from __future__ import annotations

import numpy as np
import torch

from gsstream.api import FitContext, FloatArray, Groups, IntArray, Motion, Scene, apply_motion, groups_for
from gsstream.blocks import (
    GroupTransforms,
    elementwise,
    fit_transforms_adam,
    groups_of_rows,
    groupwise_max,
    pixel_size,
    predict_transforms,
)
from gsstream_hicom.settings import MotionSettings

#: The box whose volume the cells share holds this part of the Gaussians along each axis.
BOX = (0.05, 0.95)


def cell_sides(means: FloatArray, settings: MotionSettings) -> list[float]:
    """Return the side of the cells of every grid, scene units, the coarsest first."""
    low, high = np.quantile(means.astype(np.float64), BOX, axis=0)
    volume = float(np.prod(np.maximum(high - low, 1e-6)))
    finest = max((volume * settings.per_cell / len(means)) ** (1 / 3), 1e-6)
    return [float(np.float32(finest * 2**level)) for level in reversed(range(settings.levels))]


def fitted_motions(
    scene: Scene, work: FitContext, rows: IntArray, epochs: int, settings: MotionSettings, order: np.random.Generator
) -> tuple[tuple[Motion, ...], Scene]:
    """Return the motions of a frame, one for each grid, and the scene after them."""
    pixel = pixel_size(scene.gaussians.means, work.cameras)
    start, motions = scene, []
    total = epochs * len(work.cameras)
    for level, side in enumerate(cell_sides(scene.gaussians.means, settings)):
        groups = groups_for(scene, side, 1, regroup=True)
        able = np.flatnonzero(groups_of_rows(groups, rows))
        iterations = total * (level + 1) // settings.levels - total * level // settings.levels
        if not len(able) or not iterations:
            continue
        motion = _fitted(scene, start, work, groups, able, iterations, pixel, settings, order)
        if motion.is_empty:
            continue
        motions.append(motion)
        scene = apply_motion(scene, motion)[0]
        work = work.on(scene.gaussians.map(torch.from_numpy))
    return tuple(motions), scene


def _fitted(
    scene: Scene, start: Scene, work: FitContext, groups: Groups, able: IntArray, iterations: int, pixel: float,
    settings: MotionSettings, order: np.random.Generator,
) -> Motion:  # fmt: skip
    """One grid: the transforms of its cells, rounded."""
    marks = np.zeros(groups.count, np.uint8)
    marks[able] = 1
    moves = _warm(scene, start, predict_transforms(scene, groups, marks, predicted=False), settings.momentum)
    # Half a cell from its centre, a turn of one unit moves a Gaussian by a pixel, too.
    turn = pixel / groups.cell
    unit = np.array([pixel] * 3 + [turn] * 3)
    measure = elementwise if settings.measure == "each" else groupwise_max
    rates = [settings.lr] * iterations
    found = fit_transforms_adam(scene, work, moves, unit, rates, order, measure, settings.l1_weight)
    steps = float(np.float32(settings.step * pixel)), float(np.float32(settings.step * turn))
    symbols = np.rint(found / np.array([steps[0]] * 3 + [steps[1]] * 3)).astype(np.int32)
    moved = symbols.any(1)
    marks[able[~moved]] = 0
    return Motion(groups.cell, 1, marks, symbols[moved], *steps, predicted=False, regroup=True)


def _warm(scene: Scene, start: Scene, moves: GroupTransforms, momentum: float) -> GroupTransforms:
    """Moves that begin with a share of the last frame's motion, less what coarser cells have moved by already."""
    if start.displacement is None or momentum == 0:
        return moves
    past: FloatArray = np.zeros((len(scene.gaussians), 3))
    past[start.displacement.rows] = momentum * start.displacement.translation
    left = (past - (scene.gaussians.means.astype(np.float64) - start.gaussians.means))[moves.rows]
    counts = np.bincount(moves.group, minlength=len(moves.center))
    columns = [np.bincount(moves.group, left[:, i], len(moves.center)) / counts for i in range(3)]
    return moves._replace(translation=np.stack(columns, 1))

