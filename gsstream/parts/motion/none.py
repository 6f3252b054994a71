"""Still: nothing is moved before the residual."""

from __future__ import annotations

from typing import Any, ClassVar, final

from gsstream.core.changes import Motion, Scene
from gsstream.core.rng import Rng
from gsstream.parts.motion.base import MotionPart, MotionTraits
from gsstream.parts.render.work import FitContext


@final
class Still(MotionPart):
    """Proposes no motion: every frame starts from where the last one ended (the null part, and S2GS as published)."""

    source: ClassVar[str] = "gsstream"
    traits: ClassVar[MotionTraits] = MotionTraits(momentum=0.0)

    def propose(self, scene: Scene, work: FitContext, rng: Rng, memory: Any = None) -> tuple[Motion, ...]:
        return ()
