"""Coasting: what moved in the last frame goes on moving."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, final

import numpy as np
import torch
from pydantic import Field

from gsstream.core.changes import Motion, Scene
from gsstream.core.changes.motion import GroupTransforms, predict_transforms
from gsstream.core.part import PartConfig
from gsstream.core.rng import Rng
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.parts.motion.base import MotionPart
from gsstream.parts.motion.fitting import narrow_to
from gsstream.parts.motion.groups import changed_groups, displaced_groups, known_groups
from gsstream.parts.render.work import FitContext
from gsstream.parts.render.wrt import WrtTransforms


@final
class Coasting(MotionPart):
    """Lets every group that was displaced in the last frame, and lies in what changed now, continue at its velocity.

    The velocity is the mean over the group's displaced rows, which every player computes from the packets so far: a
    moving group costs about a bit. Where nothing changed nothing moves, so a velocity dies when its body stops.
    """

    class Config(PartConfig):
        pixels: float = Field(default=8.0, gt=0, le=1000, description="side of a group, pixels at median distance")
        brightness_bins: int = Field(default=1, ge=1, le=16, description="classes of brightness, each its own group")
        votes: float = Field(
            default=0.5, ge=0, le=1, description="share of its views in which a Gaussian must lie in changed tiles"
        )
        share: float = Field(default=0.5, ge=0, le=1, description="share of a group's Gaussians that must lie there")
        displaced: float = Field(
            default=0.1, ge=0, le=1, description="share of a group's Gaussians that the last frame must have displaced"
        )
        asked: float = Field(
            default=0.5, ge=0, le=1, description="share of the cameras that check each group, in turn; 0: none does"
        )

    source: ClassVar[str] = "gsstream"

    def propose(self, scene: Scene, work: FitContext, rng: Rng, memory: Any = None) -> tuple[Motion, ...]:
        if scene.displacement is None:
            return ()
        groups = known_groups(scene, work.cameras, self.config.pixels, self.config.brightness_bins)
        config = self.config
        moving = displaced_groups(groups, scene, config.displaced)
        moving &= changed_groups(groups, work, config.votes, config.share)
        if config.asked and moving.any():
            transforms = predict_transforms(scene, groups, moving.astype(np.uint8), predicted=True)
            change = loss_change(work, transforms, rotating_views(len(work.cameras), config.asked, work.index))
            moving[np.flatnonzero(moving)[change >= 0]] = False
        symbols = np.zeros((int(moving.sum()), 6), np.int32)
        return (Motion(groups.cell, groups.brightness_bins, moving.astype(np.uint8), symbols),)


def loss_change(
    work: FitContext, transforms: GroupTransforms[FloatArray], views: Sequence[int] | IntArray
) -> FloatArray:
    """Return the change [K] of the loss, summed over views, that each group's move brings about; below 0 it helps.

    It is the derivative of the loss half-way, along the move: for a loss that is quadratic between the two ends it is
    their difference, and one pass over the views answers for every group at once.
    """
    base, whole = narrow_to(work, transforms)
    half = whole._replace(translation=whole.translation / 2, rotation=whole.rotation / 2)
    grad = torch.stack([work.loss_and_grad(int(view), WrtTransforms(base, half)).grad for view in views]).sum(0)
    change: FloatArray = (grad * torch.cat([whole.translation, whole.rotation], 1)).sum(1).cpu().numpy()
    return change


def rotating_views(number: int, share: float, frame: int) -> IntArray:
    """Return the views that take their turn in a frame: a share of all, evenly spread, others in the next frame."""
    count = max(1, round(share * number))
    return np.unique((np.arange(count) * number // count + frame) % number)
