"""The slots of a recipe, in the one place that lists them with their contracts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypedDict

from gsstream.core.kinds import METHOD_SLOTS
from gsstream.method.base import StreamingMethod
from gsstream.parts.backend.base import Renderer
from gsstream.parts.confidence.base import ConfidenceEstimator
from gsstream.parts.gate.base import GateSampler
from gsstream.parts.growth.base import Growth
from gsstream.parts.motion.base import MotionPart
from gsstream.parts.propagation.base import Propagation
from gsstream.parts.regularizer.base import Regularizer
from gsstream.parts.structure.base import Structure
from gsstream.parts.update.base import UpdateRule

SLOTS = (*METHOD_SLOTS, "streaming_method", "renderer")


@dataclass(frozen=True, slots=True)
class LiveParts:
    """A live part in every slot."""

    structure: Structure
    confidence: ConfidenceEstimator
    propagation: Propagation
    gate: GateSampler
    motion: MotionPart
    update: UpdateRule
    growth: Growth
    regularizer: Regularizer
    streaming_method: StreamingMethod[Any]
    renderer: Renderer


class Parts(TypedDict, total=False):
    """Slot -> part: a part that was made already, or the name of a part, made from its values in ``settings``."""

    structure: Structure | str
    confidence: ConfidenceEstimator | str
    propagation: Propagation | str
    gate: GateSampler | str
    motion: MotionPart | str
    update: UpdateRule | str
    growth: Growth | str
    regularizer: Regularizer | str
    streaming_method: StreamingMethod[Any] | str
    renderer: Renderer | str
