"""Confidence estimators, for the common checks."""

from __future__ import annotations

from gsstream.parts.confidence.base import ConfidenceEstimator
from gsstream.testing.cases import World
from gsstream.testing.drive import Behaviour, Outputs, Poison, poisons_of

#: A pixel that every camera of the cloud covers.
SPOT = (10, 10)


def outputs(part: ConfidenceEstimator, world: World) -> Outputs:
    """Return logits per Gaussian."""
    return {"estimate()": part.estimate(world)}


def _in_frame(world: World, value: float) -> None:
    world.now[1][SPOT] = value


def _in_frame_before(world: World, value: float) -> None:
    world.before[1][SPOT] = value


POISONS = (
    Poison("a pixel of view 1", "view 1", _in_frame),
    Poison("a pixel of view 1 of the frame before", "view 1", _in_frame_before),
    *poisons_of(*(f"gaussians.{name}" for name in ("means", "quats", "scales", "opacities", "sh0"))),
)
BEHAVIOUR = Behaviour(outputs, POISONS, keeps_precision=False, by_gaussian=True)
