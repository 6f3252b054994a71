"""Hierarchical coherent motion: from coarse cells to fine ones, every grid on the scene that the last one left."""

from __future__ import annotations

from typing import Any, Literal, final

import numpy as np
import torch
from pydantic import Field

from gsstream.api import (
    FitContext,
    FloatArray,
    Motion,
    MotionPart,
    MotionTraits,
    PartConfig,
    Rng,
    Scene,
    apply_motion,
    groups_for,
)
from gsstream.blocks import (
    GroupTransforms,
    elementwise,
    enlargement,
    fit_transforms_adam,
    groups_of_rows,
    groupwise_max,
    pixel_size,
    predict_transforms,
    rounded_motion,
)

#: Quantiles of the centres along each axis at which the box ends whose volume gives the side of the cells.
BOX = (0.05, 0.95)
#: Least share of the views that show a Gaussian in which it must lie in changed tiles, to take part.
VOTES = 0.75


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
        lr: float = Field(default=0.25, gt=0, le=10, description="step of the fit, pixels at a width of 320")
        l1_weight: float = Field(default=0.0, ge=0, description="weight of the mean absolute motion, pixels")
        step: float = Field(default=0.1, gt=0, le=10, description="quantisation step, pixels")
        measure: Literal["each", "cell"] = Field(
            default="each",
            description="what a step is divided by; each: every number of a cell by its own gradient (Adam); cell: all "
            "six by the largest",
        )

    def claims(self) -> MotionTraits:
        return MotionTraits(finds_motion=True, momentum=self.config.momentum)

    def propose(self, scene: Scene, work: FitContext, rng: Rng, memory: Any = None) -> tuple[Motion, ...]:
        config, start, motions = self.config, scene, []
        rows = work.changed_rows(VOTES).nonzero()[:, 0].cpu().numpy()
        pixel, order = pixel_size(scene.gaussians.means, work.cameras), rng.numpy("hicom", work.index)
        lr = config.lr * enlargement(work.cameras.width)
        total = work.scaled(config.epochs) * len(work.cameras)
        measure = elementwise if config.measure == "each" else groupwise_max
        for level, side in enumerate(cell_sides(scene.gaussians.means, config.levels, config.per_cell)):
            groups = groups_for(scene, side, 1, regroup=True)
            marks = groups_of_rows(groups, rows, work.shell_rows).astype(np.uint8)
            able = np.flatnonzero(marks)
            iterations = total * (level + 1) // config.levels - total * level // config.levels
            if not len(able) or not iterations:
                continue
            transforms = predict_transforms(scene, groups, marks, predicted=False)
            transforms = _warm_started(scene, start, transforms, config.momentum)
            # Half a cell from its centre, a rotation of one unit moves a Gaussian by a pixel, too.
            unit = np.repeat([pixel, pixel / side], 3)
            found = fit_transforms_adam(
                work,
                transforms,
                unit,
                rates=[lr] * iterations,
                order=order,
                measure=measure,
                l1_weight=config.l1_weight,
            )
            motion = rounded_motion(
                groups, able, found, translation_step=config.step * pixel, rotation_step=config.step * pixel / side
            )
            if motion is None:
                continue
            motions.append(motion)
            scene = apply_motion(scene, motion)[0]
            work = work.on(scene.gaussians.map(torch.from_numpy))
        return tuple(motions)


def cell_sides(means: FloatArray, levels: int, per_cell: float) -> list[float]:
    """Return the side of the cells of every grid, scene units, the coarsest first."""
    low, high = np.quantile(means.astype(np.float64), BOX, axis=0)
    volume = float(np.prod(np.maximum(high - low, 1e-6)))
    finest = max((volume * per_cell / len(means)) ** (1 / 3), 1e-6)
    return [float(np.float32(finest * 2**level)) for level in reversed(range(levels))]


def _warm_started(
    scene: Scene, start: Scene, transforms: GroupTransforms[FloatArray], momentum: float
) -> GroupTransforms[FloatArray]:
    """Return transforms that begin with a share of the last motion, less the motion by which coarser cells moved."""
    if start.ahead is None or momentum == 0:
        return transforms
    past: FloatArray = np.zeros((len(scene.gaussians), 3))
    past[start.ahead.rows] = momentum * start.ahead.translation
    left = (past - (scene.gaussians.means.astype(np.float64) - start.gaussians.means))[transforms.rows]
    counts = np.bincount(transforms.group, minlength=len(transforms.center))
    columns = [np.bincount(transforms.group, left[:, i], len(transforms.center)) / counts for i in range(3)]
    return transforms._replace(translation=np.stack(columns, 1))
