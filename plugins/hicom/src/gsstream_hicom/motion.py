"""Hierarchical coherent motion: from coarse cells to fine ones, every grid on the scene that the last one left."""

from __future__ import annotations

from typing import Any, Literal, final

import numpy as np
import torch
from pydantic import Field

from gsstream.api import (
    FitContext,
    FloatArray,
    Groups,
    Motion,
    MotionPart,
    PartConfig,
    Rng,
    Scene,
    apply_motion,
    groups_for,
)
from gsstream.blocks import (
    GroupTransforms,
    elementwise,
    fit_transforms_adam,
    groups_of_rows,
    groupwise_max,
    pixel_size,
    predict_transforms,
)

#: The box whose volume the cells share holds this part of the Gaussians along each axis.
BOX = (0.05, 0.95)


@final
class CoherentMotion(MotionPart):
    """Moves the cells of nested grids rigidly (HiCoM: Gao et al., NeurIPS 2024).

    Every grid, from the coarsest to the finest, gets its share of the passes and is fitted on the scene that the
    coarser ones left. Defaults are the published values where a value is known; where this differs, and why, is in the
    README of this plugin.
    """

    source = "HiCoM (Gao et al. 2024)"

    class Config(PartConfig):
        epochs: int = Field(default=5, ge=1, le=1000, description="passes over the training cameras, of all grids")
        levels: int = Field(default=3, ge=1, le=6, description="nested grids; each has cells twice as wide as the next")
        per_cell: float = Field(default=5.0, gt=0, description="Gaussians per cell of the finest grid, on average")
        momentum: float = Field(default=0.6, ge=0, le=1, description="share of the last frame's motion to begin with")
        lr: float = Field(default=0.25, gt=0, le=10, description="step of the fit, pixels per iteration")
        l1_weight: float = Field(default=0.0, ge=0, description="weight of the mean absolute motion, pixels")
        step: float = Field(default=0.1, gt=0, le=10, description="quantisation step, pixels")
        measure: Literal["each", "cell"] = Field(
            default="each",
            description="what a step is divided by; each: every number of a cell by its own gradient (Adam); cell: all "
            "six by the largest",
        )  # fmt: skip
        votes: float = Field(
            default=0.75, ge=0, le=1, description="share of its views in which a Gaussian must lie in what changed"
        )

    def propose(self, scene: Scene, work: FitContext, rng: Rng, memory: Any = None) -> tuple[Motion, ...]:
        config, start, motions = self.config, scene, []
        rows = work.changed_rows(config.votes).nonzero()[:, 0].numpy()
        pixel, order = pixel_size(scene.gaussians.means, work.cameras), rng.numpy("hicom", work.index)
        total = work.scaled(config.epochs) * len(work.cameras)
        for level, side in enumerate(cell_sides(scene.gaussians.means, config.levels, config.per_cell)):
            groups = groups_for(scene, side, 1, regroup=True)
            able = np.flatnonzero(groups_of_rows(groups, rows))
            iterations = total * (level + 1) // config.levels - total * level // config.levels
            if not len(able) or not iterations:
                continue
            marks = np.zeros(groups.count, np.uint8)
            marks[able] = 1
            moves = predict_transforms(scene, groups, marks, predicted=False)
            moves = _warm_started(scene, start, moves, config.momentum)
            motion = self._fitted(scene, work, groups, moves, iterations, pixel, order)
            if motion.is_empty:
                continue
            motions.append(motion)
            scene = apply_motion(scene, motion)[0]
            work = work.on(scene.gaussians.map(torch.from_numpy))
        return tuple(motions)

    def _fitted(
        self, scene: Scene, work: FitContext, groups: Groups, moves: GroupTransforms, iterations: int, pixel: float,
        order: np.random.Generator,
    ) -> Motion:  # fmt: skip
        """One grid: the transforms of the cells in ``moves``, rounded."""
        config = self.config
        # Half a cell from its centre, a rotation of one unit moves a Gaussian by a pixel, too.
        unit = np.array([pixel] * 3 + [pixel / groups.cell] * 3)
        measure = elementwise if config.measure == "each" else groupwise_max
        rates = [config.lr] * iterations
        found = fit_transforms_adam(scene, work, moves, unit, rates, order, measure, config.l1_weight)
        steps = float(np.float32(config.step * pixel)), float(np.float32(config.step * pixel / groups.cell))
        symbols = np.rint(found / np.array([steps[0]] * 3 + [steps[1]] * 3)).astype(np.int32)
        moved = symbols.any(1)
        marks = np.zeros(groups.count, np.uint8)
        marks[np.unique(groups.group_of[moves.rows])[moved]] = 1
        return Motion(groups.cell, 1, marks, symbols[moved], *steps, predicted=False, regroup=True)


def cell_sides(means: FloatArray, levels: int, per_cell: float) -> list[float]:
    """Return the side of the cells of every grid, scene units, the coarsest first."""
    low, high = np.quantile(means.astype(np.float64), BOX, axis=0)
    volume = float(np.prod(np.maximum(high - low, 1e-6)))
    finest = max((volume * per_cell / len(means)) ** (1 / 3), 1e-6)
    return [float(np.float32(finest * 2**level)) for level in reversed(range(levels))]


def _warm_started(scene: Scene, start: Scene, moves: GroupTransforms, momentum: float) -> GroupTransforms:
    """Transforms that begin with a share of the last frame's motion, less what coarser cells have moved by already."""
    if start.displacement is None or momentum == 0:
        return moves
    past: FloatArray = np.zeros((len(scene.gaussians), 3))
    past[start.displacement.rows] = momentum * start.displacement.translation
    left = (past - (scene.gaussians.means.astype(np.float64) - start.gaussians.means))[moves.rows]
    counts = np.bincount(moves.group, minlength=len(moves.center))
    columns = [np.bincount(moves.group, left[:, i], len(moves.center)) / counts for i in range(3)]
    return moves._replace(translation=np.stack(columns, 1))
