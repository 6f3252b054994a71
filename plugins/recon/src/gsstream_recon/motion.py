"""Fitting the motions of anchors to the images, and saying what they add up to."""

from __future__ import annotations

from dataclasses import dataclass

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


@dataclass(frozen=True)
class AnchoredCells:
    """Cells that follow the nearest anchor of each level: a cell's shift and turn are the sums of theirs.

    ``unit`` [6] is a step of one pixel in each number; anchors' numbers are rounded to ``step`` [6] unless it is None.
    """

    cells: GroupTransforms
    levels: list[Level]
    unit: FloatArray
    step: FloatArray | None

    def sums(self, descents: list[GroupAdam]) -> FloatArray:
        """Return shifts and turns [C, 6] of the cells, from the numbers that each level's anchors have reached."""
        total: FloatArray = np.zeros((len(self.levels[0].of), 6))
        for level, descent in zip(self.levels, descents, strict=True):
            values = descent.values * self.unit
            total += (values if self.step is None else np.rint(values / self.step) * self.step)[level.of]
        return total


def fitted_motion(
    scene: Scene, work: FitContext, rows: IntArray, anchors: tuple[AnchorLevels | None, AnchorLevels], epochs: int,
    settings: MotionSettings, order: np.random.Generator,
) -> Motion | None:  # fmt: skip
    """Return the motion of a frame, of cells of a fine grid, each about its own centre; None where nothing moves."""
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
    levels = bound(cells.center, scene.gaussians.means, anchors[1])
    anchored = AnchoredCells(cells, levels, unit, step if settings.rounded else None)
    found = _fitted(scene, work, anchored, _start(scene, cells, anchors, levels, settings), epochs, settings, order)
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
    if scene.displacement is None or before is None or not all(map(len, before.rows)):
        return [np.zeros((len(level.at), 6)) for level in levels]
    past: FloatArray = np.zeros((len(scene.gaussians), 6))
    past[scene.displacement.rows] = np.concatenate([scene.displacement.translation, scene.displacement.rotation], 1)
    mean = Level(cells.center, cells.group).mean(past[cells.rows])
    old = levels if before is now else bound(cells.center, scene.gaussians.means, before)
    return [settings.momentum * motion for motion in inherited(mean, old, levels, settings.neighbours)]


def _fitted(
    scene: Scene, work: FitContext, anchored: AnchoredCells, start: list[FloatArray], epochs: int,
    settings: MotionSettings, order: np.random.Generator,
) -> FloatArray:  # fmt: skip
    """Shifts and turns [C, 6] of the cells; all levels learn at once."""
    cells, unit = anchored.cells, anchored.unit
    measure = elementwise if settings.measure == "each" else groupwise_max
    descents = [GroupAdam(values / unit, measure) for values in start]
    work.narrow(torch.from_numpy(cells.rows))
    base = scene.gaussians.rows(cells.rows).map(torch.from_numpy)
    local = cells._replace(rows=np.arange(len(cells.rows)))
    for _ in range(epochs):
        for view in order.permutation(len(work.cameras)):
            sums = anchored.sums(descents)
            moves = local._replace(translation=sums[:, :3], rotation=sums[:, 3:])
            grad = work.loss_and_grad(int(view), WrtTransforms(base, moves)).grad.numpy() * unit
            for level, descent in zip(anchored.levels, descents, strict=True):
                l1_weight = settings.l1_weight * np.sign(descent.values) / descent.values.size
                descent.step(level.sum(grad) + l1_weight, settings.lr)
    return anchored.sums(descents)
