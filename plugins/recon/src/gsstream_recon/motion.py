"""Fitting the motions of anchors to the images, and saying what they add up to."""

from __future__ import annotations

import numpy as np
import torch

from gsstream.api import FitContext, FloatArray, IntArray, Motion, Scene, WrtTransforms, groups_for
from gsstream.blocks import (
    GroupAdam,
    GroupTransforms,
    elementwise,
    groups_of_rows,
    groupwise_max,
    pixel_size,
    predict_transforms,
)
from gsstream_recon.anchors import AnchorLevels, Level, bound, inherited
from gsstream_recon.settings import MotionSettings


def fitted_motion(
    scene: Scene, work: FitContext, rows: IntArray, anchors: tuple[AnchorLevels | None, AnchorLevels], epochs: int,
    settings: MotionSettings, order: np.random.Generator, rounded: bool = False,
) -> Motion | None:  # fmt: skip
    """Return the motion of a frame; None where nothing moves.

    Cells of a fine grid follow the nearest anchor of each level: a cell's shift and turn, about its own centre, are the
    sums of theirs.
    """
    pixel = pixel_size(scene.gaussians.means, work.cameras)
    side = float(np.float32(settings.pixels * pixel))
    groups = groups_for(scene, side, 1, regroup=True)
    marks = groups_of_rows(groups, rows).astype(np.uint8)
    if not marks.any():
        return None
    cells = predict_transforms(scene, groups, marks, predicted=False)
    # Half a cell from its centre, a turn of one unit moves a Gaussian by a pixel, too.
    unit = np.array([pixel] * 3 + [pixel / side] * 3)
    steps = float(np.float32(settings.step * pixel)), float(np.float32(settings.rotation_step))
    step = np.array([steps[0]] * 3 + [steps[1]] * 3)
    levels = bound(cells.centre, scene.gaussians.means, anchors[1])
    start = _start(scene, cells, anchors, levels, settings)
    found = _fitted(scene, work, cells, levels, start, unit, step if rounded else None, epochs, settings, order)
    symbols = np.rint(found / step).astype(np.int32)
    moved = symbols.any(1)
    if not moved.any():
        return None
    marks[np.flatnonzero(marks)[~moved]] = 0
    return Motion(side, 1, marks, symbols[moved], *steps, predicted=False, regroup=True)


def _start(
    scene: Scene, cells: GroupTransforms, anchors: tuple[AnchorLevels | None, AnchorLevels], levels: list[Level],
    settings: MotionSettings,
) -> list[FloatArray]:  # fmt: skip
    """Motions [K, 6] of the anchors that begin with a share of the last frame's."""
    before, now = anchors
    if scene.moved is None or before is None or not all(map(len, before.rows)):
        return [np.zeros((len(level.at), 6)) for level in levels]
    past: FloatArray = np.zeros((len(scene.gaussians), 6))
    past[scene.moved.rows] = np.concatenate([scene.moved.shift, scene.moved.turn], 1)
    mean = Level(cells.centre, cells.place).mean(past[cells.rows])
    old = levels if before is now else bound(cells.centre, scene.gaussians.means, before)
    return [settings.momentum * motion for motion in inherited(mean, old, levels, settings.neighbours)]


def _fitted(
    scene: Scene, work: FitContext, cells: GroupTransforms, levels: list[Level], start: list[FloatArray],
    unit: FloatArray, step: FloatArray | None, epochs: int, settings: MotionSettings, order: np.random.Generator,
) -> FloatArray:  # fmt: skip
    """Shifts and turns [C, 6] of the cells; all levels learn at once."""
    measure = elementwise if settings.measure == "each" else groupwise_max
    descents = [GroupAdam(values / unit, measure) for values in start]
    work.narrow(torch.from_numpy(cells.rows))
    base = scene.gaussians.rows(cells.rows).map(torch.from_numpy)
    local = cells._replace(rows=np.arange(len(cells.rows)))
    for _ in range(epochs):
        for view in order.permutation(len(work.cameras)):
            sums = _sums(levels, descents, unit, step)
            moves = local._replace(shift=sums[:, :3], turn=sums[:, 3:])
            grad = work.loss_and_grad(int(view), WrtTransforms(base, moves)).grad.numpy() * unit
            for level, descent in zip(levels, descents, strict=True):
                l1_weight = settings.l1_weight * np.sign(descent.values) / descent.values.size
                descent.step(level.sum(grad) + l1_weight, settings.lr)
    return _sums(levels, descents, unit, step)


def _sums(
    levels: list[Level], descents: list[GroupAdam], unit: FloatArray, step: FloatArray | None
) -> FloatArray:
    """[C, 6]: what the anchors of all levels say, each rounded to ``step`` where there is one."""
    total: FloatArray = np.zeros((len(levels[0].of), 6))
    for level, descent in zip(levels, descents, strict=True):
        values = descent.values * unit
        total += (values if step is None else np.rint(values / step) * step)[level.of]
    return total
