"""Growth: which Gaussians are born and which leave once a frame is optimised."""

from __future__ import annotations

from abc import abstractmethod

from gsstream.core.changes import Rows, Scene
from gsstream.core.part import Part
from gsstream.core.rng import Rng
from gsstream.parts.render.work import FitContext


class Growth(Part):
    """Proposes births and deaths, which travel in the packet of the frame that they belong to."""

    @abstractmethod
    def propose(self, after: Scene, work: FitContext, rng: Rng) -> Rows | None:
        """Return the rows that leave and those that join; None for neither.

        Arguments:
            after: the scene as players will have it after this frame's motions and residual (numpy; do not change it).
                Deaths are its rows; births are placed in its nodes or in new ones.
            work: the frame, seen from the scene before its residual: images, what changed, and rendering; ``work.on``
                shows it from another scene.
            rng: random streams by name and frame; draw from nothing else.
        """
