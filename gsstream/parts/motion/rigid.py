"""Rigid groups: every group that lies in what changed gets a rotation and a shift, fitted to the images."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar, final

import numpy as np
from pydantic import Field

from gsstream.core.changes import Displacement, Motion, Scene
from gsstream.core.changes.motion import GroupTransforms, predict_transforms
from gsstream.core.part import PartConfig
from gsstream.core.picture_size import enlargement
from gsstream.core.rng import Rng
from gsstream.core.shapes import FloatArray
from gsstream.parts.motion.across_key import displacement_across_key
from gsstream.parts.motion.base import MotionPart, MotionTraits
from gsstream.parts.motion.groups import changed_groups, known_groups
from gsstream.parts.motion.newton import BodySettings, Damping, fit_transforms_newton
from gsstream.parts.render.work import FitContext

#: Classes of brightness; the Gaussians of a cell and a class are a group.
BRIGHTNESS_BINS = 2
#: Share of a group's mean curvature that is added to it.
DAMPING = 0.1
#: Curvature that draws a group to its body, per pixel^2.
BODY_HOLD = 500.0
#: Times as many passes in a frame before which nothing moved, as the first and one after a key packet.
FROM_REST = 2
#: Longest step of a group, pixels at a width of 320.
LONGEST = 0.5


@final
class Rigid(MotionPart):
    """Fits one rigid transform per group, starting from the last frame's, and codes what corrects the prediction.

    A few passes over the training cameras move the groups' six numbers each, by damped Gauss-Newton steps after every
    view; only the Gaussians of groups that lie in what changed are rendered anew. After the first pass neighbouring
    groups whose motions agree are joined to bodies, which hold their groups from then on. A group that ends within
    ``least`` pixels of where it stood is left alone. After a key packet, and after frames that were skipped, a fit
    begins where the scene was heading, while the motion is coded as one from rest.
    """

    class Config(PartConfig):
        pixels: float = Field(default=12.0, gt=0, le=1000, description="side of a group, pixels at a width of 320")
        votes: float = Field(
            default=0.75, ge=0, le=1, description="share of its views in which a Gaussian must lie in changed tiles"
        )
        share: float = Field(default=0.5, ge=0, le=1, description="share of a group's Gaussians that must lie there")
        epochs: int = Field(
            default=2,
            ge=1,
            le=100,
            description="passes over the training cameras, twice as many where nothing moved in the frame before; a "
            "hurried frame makes its share",
        )
        hold: float = Field(
            default=40.0, gt=0, le=1e6, description="curvature that holds every group back besides, per pixel^2"
        )
        body_cost: float = Field(
            default=0.02,
            ge=0,
            le=1e6,
            description="loss that joining two neighbours to a body may cost after the first pass, summed over all "
            "values of all images, as a multiple of the square root of their number; 0: no bodies",
        )
        step: float = Field(default=0.1, gt=0, le=10, description="quantisation step, pixels")
        least: float = Field(default=0.25, ge=0, le=10, description="motions below this many pixels are dropped")

    source: ClassVar[str] = "gsstream; groups of one rigid motion as in HiCoM"
    traits: ClassVar[MotionTraits] = MotionTraits(finds_motion=True, momentum=1.0)

    def propose(self, scene: Scene, work: FitContext, rng: Rng, memory: Any = None) -> tuple[Motion, ...]:
        config, side = self.config, self.config.pixels * enlargement(work.cameras.width)
        groups = known_groups(scene, work.cameras, side, BRIGHTNESS_BINS)
        able = changed_groups(groups, work, config.votes, config.share)
        if not able.any():
            return ()
        # What moves a group by a pixel, scene units, and its edge, tan(angle / 2): half a cell from the centre, an
        # angle a moves a point by a * cell / 2 = tan(a / 2) * cell. The scene changes little between key packets, so a
        # pixel is measured once, when its groups are formed.
        unit = np.array([groups.cell / side] * 3 + [1 / side] * 3)
        start = begin = predict_transforms(scene, groups, able.astype(np.uint8), predicted=True)
        if (ahead := memory if isinstance(memory, Displacement) else scene.heading) is not None:
            begin = predict_transforms(
                replace(scene, displacement=ahead), groups, able.astype(np.uint8), predicted=True
            )
        found = self._fitted(work, begin, unit, rest=scene.displacement is None and scene.heading is None, rng=rng)
        predicted = np.concatenate([start.translation, start.rotation], 1)
        step = (config.step * unit).astype(np.float32).astype(np.float64)
        symbols = np.rint((found - predicted) / step).astype(np.int32)
        kept = np.abs((predicted + symbols * step) / unit).max(1) >= config.least
        moving = np.bincount(np.flatnonzero(able)[kept], minlength=groups.count).astype(np.uint8)
        return (
            Motion(
                cell=groups.cell,
                brightness_bins=groups.brightness_bins,
                moving=moving,
                symbols=symbols[kept],
                translation_step=float(step[0]),
                rotation_step=float(step[3]),
            ),
        )

    def _fitted(
        self, work: FitContext, start: GroupTransforms[FloatArray], unit: FloatArray, rest: bool, rng: Rng
    ) -> FloatArray:
        """[K, 6] shift and turn of the groups that explain the images best."""
        config, cameras = self.config, work.cameras
        return fit_transforms_newton(
            work,
            start,
            unit,
            iterations=work.scaled(config.epochs * (FROM_REST if rest else 1) * len(cameras)),
            order=rng.numpy("motion", work.index),
            damping=Damping(DAMPING, config.hold, LONGEST * enlargement(cameras.width)),
            # The part of noise in a sum of so many values grows as the root of their number.
            settings=BodySettings(
                config.body_cost * (3 * cameras.height * cameras.width * len(cameras)) ** 0.5, BODY_HOLD
            ),
        )

    def across_key(self, replaced: Scene, scene: Scene) -> Displacement | None:
        return displacement_across_key(replaced, scene)
