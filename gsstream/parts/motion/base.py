"""MotionPart: which groups of Gaussians move rigidly in a frame, before its residual is learned."""

from __future__ import annotations

from abc import abstractmethod

from gsstream.core.changes import Motion, Scene
from gsstream.core.part import Part
from gsstream.core.rng import Rng
from gsstream.parts.render.work import FitContext


class MotionPart(Part):
    """Proposes the motions that a frame begins with.

    A motion is a change of the stream (``core.changes.Motion``): encoder and player apply it with the same function,
    and its prediction from the last frame is part of that function. So a part decides which groups move and what
    corrects the prediction; it never moves Gaussians itself. The residual of the frame is learned on the moved scene.
    """

    @abstractmethod
    def propose(self, scene: Scene, work: FitContext, rng: Rng) -> tuple[Motion, ...]:
        """Return the motions of this frame, in the order in which they apply; none leaves the scene where it is.

        Arguments:
            scene: the decoded scene of the frame before, with the displacement of its rows and the groups that the last
                motion named (numpy; do not change it).
            work: the frame: images, what changed, and rendering with some rows moving.
            rng: random streams by name and frame; draw from nothing else.
        """
