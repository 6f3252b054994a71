"""None: the number of Gaussians stays what frame 0 made it."""

from __future__ import annotations

from typing import ClassVar, final

from gsstream.core.changes import RowEdit, Scene
from gsstream.core.rng import Rng
from gsstream.parts.growth.base import Growth
from gsstream.parts.render.work import FitContext


@final
class NoGrowth(Growth):
    """Adds and removes nothing (the null part, and S2GS as published)."""

    source: ClassVar[str] = "gsstream"

    def propose(self, after: Scene, work: FitContext, rng: Rng) -> RowEdit | None:
        return None
