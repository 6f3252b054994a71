"""Propagations, for the common checks."""

from __future__ import annotations

from gsstream.parts.propagation.base import Propagation
from gsstream.testing.cases import World
from gsstream.testing.drive import Behaviour, Outputs, poison_logits


def outputs(part: Propagation, world: World) -> Outputs:
    """Return logits per node."""
    return {"propagate()": part.propagate(world.logits, world.hierarchy)}


BEHAVIOUR = Behaviour(outputs, poison_logits)
