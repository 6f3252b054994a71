"""What the common checks have to know of a kind: how the engine calls such a part, and what its outputs mean."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from gsstream.core.part import Part
from gsstream.parts.gate.base import GateSampler
from gsstream.testing.cases import World
from gsstream.testing.registry import kind_of

Outputs = dict[str, torch.Tensor]


@dataclass(frozen=True)
class Behaviour:
    """How the common checks treat a kind; each kind with ``PartKind.behaviour`` has one in its room.

    Arguments:
        outputs: every output of every method on a world, tensor by tensor.
        poison: put a value into something that the part reads, in place; returns what that is.
        keeps_precision: outputs have the precision of the logits given; otherwise they are float32.
        by_gaussian: outputs have a row per Gaussian, which moves with it.
        no_order: outputs whose names begin so are not compared after a permutation: the kind has a check of its own.
        hands_on: may hand on a value that is not finite, because it shows in the loss.
    """

    outputs: Callable[[Any, World], Outputs]
    poison: Callable[[World, float], str]
    keeps_precision: bool = True
    by_gaussian: bool = False
    no_order: str | None = None
    hands_on: bool = False


def behaviour_of(part: Part) -> Behaviour:
    """Return the behaviour of the part's kind."""
    found: Behaviour = importlib.import_module(f"gsstream.testing.{kind_of(part)}.behaviour").BEHAVIOUR
    return found


def outputs(part: Part, world: World) -> Outputs:
    """Return what ``part`` makes of a world, tensor by tensor."""
    return behaviour_of(part).outputs(part, world)


def draw(part: GateSampler, number: int, seed: int = 7) -> torch.Tensor | None:
    """Draw noise from a fresh generator.

    Arguments:
        part: a gate.
        number: of nodes.
        seed: of the generator.
    """
    return part.noise(number, torch.Generator().manual_seed(seed))


def poison_logits(world: World, value: float) -> str:
    """Change the logit of one Gaussian to a value that no logit has."""
    world.logits[5] = value
    return "one logit"
