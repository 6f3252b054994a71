"""Motion by anchors on several levels: the fit to the images, and the sums of motions that are sent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, final

import numpy as np
import torch
from pydantic import Field

from gsstream.api import (
    Delta,
    FitContext,
    FloatArray,
    Layout,
    Motion,
    MotionPart,
    MotionTraits,
    PartConfig,
    Rng,
    Scene,
    WrtTransforms,
    groups_for,
)
from gsstream.blocks import (
    GroupAdam,
    GroupTransforms,
    elementwise,
    enlargement,
    found_transforms,
    groups_of_rows,
    groupwise_max,
    narrow_to,
    pixel_size,
    predict_transforms,
    rounded_motion,
)
from gsstream_recon.anchors import AnchorLevels, Level, bound, followed, inherited

#: Anchors of a level per anchor of the next coarser one.
RATIO = 3.0
#: Old anchors from which a new anchor inherits its motion.
NEIGHBOURS = 3
#: Least share of the views that show a Gaussian in which it must lie in changed tiles, to take part.
VOTES = 0.75


@dataclass(frozen=True)
class AnchoredCells:
    """Cells that follow the nearest anchor of each level: a cell's shift and turn are the sums of theirs.

    ``unit`` [6] is a step of one pixel in each number; anchors' numbers are rounded to ``step`` [6] unless it is None.
    """

    cells: GroupTransforms[FloatArray]
    levels: list[Level]
    unit: FloatArray
    step: FloatArray | None

    def on(self, device: torch.device) -> tuple[list[torch.Tensor], torch.Tensor, torch.Tensor | None]:
        """Return the anchor [C] that each cell follows on every level, ``unit`` and ``step`` on a device."""
        follows = [torch.from_numpy(level.of).to(device) for level in self.levels]
        step = None if self.step is None else torch.from_numpy(self.step).to(device)
        return follows, torch.from_numpy(self.unit).to(device), step


@final
class AnchorMotion(MotionPart):
    """Moves small cells by anchors drawn among the Gaussians on several levels (ReCon-GS, NeurIPS 2025).

    Anchors are drawn anew every second frame and inherit what the old ones knew. What is sent is the rigid motion of
    every cell, the sum of its anchors' motions. With ``rounded``, motions are rounded while they are fitted, and have
    the gradient of motions that are not rounded (QuARC-GS, 2026). Defaults are the published values where a value is
    known; where
    this differs, and why, is in the README of this plugin.
    """

    source = "ReCon-GS (NeurIPS 2025)"

    class Config(PartConfig):
        epochs: int = Field(default=5, ge=1, le=1000, description="passes over the training cameras")
        per_anchor: float = Field(default=24.0, ge=1, description="Gaussians per anchor of the finest level")
        levels: int = Field(default=3, ge=1, le=6, description="levels of anchors, whose motions add up")
        every: int = Field(default=2, ge=1, description="frames after which anchors are drawn anew")
        momentum: float = Field(default=0.6, ge=0, le=1, description="share of the last frame's motion to begin with")
        lr: float = Field(default=0.25, gt=0, le=10, description="step of the fit, pixels at a width of 320")
        l1_weight: float = Field(default=0.0, ge=0, description="weight of the mean absolute motion, pixels")
        measure: Literal["each", "anchor"] = Field(
            default="each",
            description="what a step is divided by; each: every number of an anchor by its own gradient (Adam); "
            "anchor: all six by the largest",
        )
        pixels: float = Field(
            default=6.0, gt=0, le=1000, description="side of the cells that follow anchors, pixels at a width of 320"
        )
        step: float = Field(default=0.1, gt=0, le=10, description="quantisation step of translations, pixels")
        rotation_step: float = Field(
            default=0.01, gt=0, le=1, description="quantisation step of rotations, tan(angle / 2)"
        )
        rounded: bool = Field(
            default=False, description="round every anchor's motion to these steps while it is fitted"
        )

    def claims(self) -> MotionTraits:
        return MotionTraits(finds_motion=True, momentum=self.config.momentum)

    def propose(self, scene: Scene, work: FitContext, rng: Rng, memory: Any = None) -> tuple[Motion, ...]:
        config, means = self.config, scene.gaussians.means
        pixel = pixel_size(means, work.cameras)
        side = float(np.float32(config.pixels * enlargement(work.cameras.width) * pixel))
        groups = groups_for(scene, side, 1, regroup=True)
        rows = work.changed_rows(VOTES).nonzero()[:, 0].cpu().numpy()
        marks = groups_of_rows(groups, rows, work.shell_rows).astype(np.uint8)
        if not marks.any():
            return ()
        anchors = self._anchors(memory, work.index, len(means), rng)
        work.log.set(anchors=[len(level) for level in anchors.rows])
        cells = predict_transforms(scene, groups, marks, predicted=False)
        # Half a cell from its centre, a rotation of one unit moves a Gaussian by a pixel, too.
        unit = np.repeat([pixel, pixel / side], 3)
        steps = float(np.float32(config.step * pixel)), float(np.float32(config.rotation_step))
        step = np.repeat(steps, 3)
        anchored = AnchoredCells(cells, bound(cells.center, means, anchors), unit, step if config.rounded else None)
        start = self._start(scene, anchored, memory, anchors)
        found = self._fitted(work, anchored, start, rng.numpy("recon", work.index))
        motion = rounded_motion(groups, np.flatnonzero(marks), found, *steps)
        return () if motion is None else (motion,)

    def follow(self, memory: Any, frame: int, before: Layout, delta: Delta, rng: Rng) -> AnchorLevels:
        anchors = self._anchors(memory, frame, len(before.unit_of), rng)
        return followed(anchors, before, delta)

    def _anchors(self, memory: AnchorLevels | None, frame: int, number: int, rng: Rng) -> AnchorLevels:
        """The anchors of the frame before; new ones where those are too old, or where a level has none.

        Both ends could draw them: from the seed of the run and the number of the frame.
        """
        config = self.config
        if memory is not None and frame - memory.drawn < config.every and all(map(len, memory.rows)):
            return memory
        order = rng.numpy("recon/anchors", frame).permutation(number)
        sizes = [number / config.per_anchor / RATIO**level for level in reversed(range(config.levels))]
        return AnchorLevels(frame, tuple(np.sort(order[: max(1, round(size))]) for size in sizes))

    def _start(
        self, scene: Scene, anchored: AnchoredCells, before: AnchorLevels | None, now: AnchorLevels
    ) -> list[FloatArray]:
        """Motions [K, 6] of the anchors that begin with a share of the last frame's."""
        cells, levels = anchored.cells, anchored.levels
        if scene.ahead is None or before is None or not all(map(len, before.rows)):
            return [np.zeros((len(level.at), 6)) for level in levels]
        past: FloatArray = np.zeros((len(scene.gaussians), 6))
        past[scene.ahead.rows] = np.concatenate([scene.ahead.translation, scene.ahead.rotation], 1)
        mean = Level(cells.center, cells.group).mean(past[cells.rows])
        old = levels if before is now else bound(cells.center, scene.gaussians.means, before)
        return [self.config.momentum * motion for motion in inherited(mean, old, levels, NEIGHBOURS)]

    def _fitted(
        self,
        work: FitContext,
        anchored: AnchoredCells,
        start: list[FloatArray],
        order: np.random.Generator,
    ) -> FloatArray:
        """Translations and rotations [C, 6] of the cells; all levels learn at once."""
        config, (base, local) = self.config, narrow_to(work, anchored.cells)
        follows, unit, step = anchored.on(base.means.device)
        measure = elementwise if config.measure == "each" else groupwise_max
        descents = [GroupAdam(torch.from_numpy(values).to(unit.device) / unit, measure) for values in start]

        def cells() -> torch.Tensor:
            values = [descent.values * unit for descent in descents]
            if step is not None:
                values = [torch.round(value / step) * step for value in values]
            return torch.stack([value[of] for value, of in zip(values, follows, strict=True)]).sum(0)

        for _ in range(work.scaled(config.epochs)):
            for view in order.permutation(len(work.cameras)):
                now = cells()
                moves = local._replace(translation=now[:, :3], rotation=now[:, 3:])
                grad = work.loss_and_grad(int(view), WrtTransforms(base, moves)).grad * unit
                for of, descent in zip(follows, descents, strict=True):
                    by_anchor = torch.zeros_like(descent.values).index_add_(0, of, grad)
                    l1_grad = config.l1_weight * descent.values.sign() / descent.values.numel()
                    descent.step(by_anchor + l1_grad, config.lr * enlargement(work.cameras.width))
        return found_transforms(cells())
