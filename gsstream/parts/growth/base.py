"""Growth: which Gaussians are added and which are removed once a frame is optimised."""

from __future__ import annotations

from abc import abstractmethod

from gsstream.core.changes import RowEdit, Scene
from gsstream.core.part import Part
from gsstream.core.rng import Rng
from gsstream.parts.render.work import FitContext


class Growth(Part):
    """Proposes Gaussians to add and rows to remove; they travel in the packet of the frame that they belong to."""

    @abstractmethod
    def propose(self, after: Scene, work: FitContext, rng: Rng) -> RowEdit | None:
        """Return the rows that leave and those that join; None for neither.

        Arguments:
            after: the scene as players will have it after this frame's motions and residual (numpy; do not change it).
                Removed rows are its rows, of which those of ``work.shell_rows`` stay; added Gaussians are placed in its
                nodes or in new ones.
            work: the frame, seen from the scene before its residual: images, what changed, and rendering; ``work.on``
                shows it from another scene.
            rng: random streams by name and frame; draw from nothing else.
        """
