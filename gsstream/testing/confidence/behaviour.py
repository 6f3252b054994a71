"""Confidence estimators, for the common checks."""

from __future__ import annotations

from gsstream.parts.confidence.base import ConfidenceEstimator
from gsstream.testing.cases import World
from gsstream.testing.drive import Behaviour, Outputs

#: A pixel that every camera of the cloud covers.
SPOT = (10, 10)


def outputs(part: ConfidenceEstimator, world: World) -> Outputs:
    """Return logits per Gaussian."""
    return {"estimate()": part.estimate(world)}


def poison(world: World, value: float) -> str:
    """Change one pixel of every image of the frame to a value that no image has."""
    for image in world.now:
        image[SPOT] = value
    return "one pixel of every image"


BEHAVIOUR = Behaviour(outputs, poison, keeps_precision=False, by_gaussian=True)
