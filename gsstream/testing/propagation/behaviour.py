"""Propagations, for the common checks."""

from __future__ import annotations

from gsstream.parts.propagation.base import Propagation
from gsstream.testing.cases import World
from gsstream.testing.drive import Behaviour, Outputs, poisons_of


def outputs(part: Propagation, world: World) -> Outputs:
    """Return logits per node."""
    return {"propagate()": part.propagate(world.logits, world.hierarchy)}


BEHAVIOUR = Behaviour(outputs, poisons_of("logits", usual=(12.0, -12.0)))
