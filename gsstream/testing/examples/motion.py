"""Keep going: a group that moved in the last frame, and lies in what changed, moves on as it did."""

from __future__ import annotations

from typing import Any, final

import numpy as np
from pydantic import Field

from gsstream.api import FitContext, Motion, MotionPart, MotionTraits, PartConfig, Rng, Scene, groups_for


@final
class ExampleMotion(MotionPart):
    """Continues the velocity of groups of Gaussians; it corrects nothing, so a moving group costs about a bit.

    Every player computes the velocity itself, from the packets so far. Where nothing changes, nothing goes on moving.
    """

    source = "gsstream"
    traits = MotionTraits(momentum=1.0)

    class Config(PartConfig):
        cell: float = Field(default=0.03, gt=0, le=1, description="side of a group, fraction of the rig's extent")
        votes: float = Field(
            default=0.5, ge=0, le=1, description="share of its views in which a Gaussian must lie in changed tiles"
        )

    def propose(self, scene: Scene, work: FitContext, rng: Rng, memory: Any = None) -> tuple[Motion, ...]:
        if scene.displacement is None:
            return ()
        # A packet holds the cell in single precision, and both ends must form the same groups.
        cell = float(np.float32(self.config.cell * work.cameras.extent))
        groups = groups_for(scene, cell, brightness_bins=1)
        moved = np.zeros(groups.count, bool)
        moved[groups.group_of[scene.displacement.rows]] = True
        changed = work.changed_rows(self.config.votes).numpy()
        total = np.bincount(groups.group_of, minlength=groups.count)
        inside = np.bincount(groups.group_of[changed], minlength=groups.count)
        moving = moved & (2 * inside > total)
        corrections = np.zeros((int(moving.sum()), 6), np.int32)
        return (Motion(cell, 1, moving.astype(np.uint8), corrections),)
