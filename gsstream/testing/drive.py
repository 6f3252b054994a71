"""Knowledge of the common checks about a kind: how the engine calls such a part, and how its outputs are compared."""

from __future__ import annotations

import functools
import importlib
import operator
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
class Poison:
    """Something that a part may read and in which a value is put, in place."""

    what: str  # it is, for the message
    named: str  # what a refusal of it must name
    put: Callable[[World, float], None]  # a value into a world
    #: Two values that the field may have; a part to which they make no difference does not read the field.
    usual: tuple[float, float] = (0.75, 0.25)


@dataclass(frozen=True)
class Behaviour:
    """How the common checks treat a kind; the module of each kind with ``PartKind.behaviour`` has one."""

    outputs: Callable[[Any, World], Outputs]  # every output of every method on a world, tensor by tensor
    poisons: tuple[Poison, ...]  # what a part may read, one value of each
    keeps_precision: bool = True  # outputs have the precision of the logits given; otherwise they are float32
    by_gaussian: bool = False  # outputs have a row per Gaussian, which moves with it
    #: Outputs whose names begin so are not compared after a permutation: the kind has a check of its own.
    no_order: str | None = None
    hands_on: bool = False  # may hand on a value that is not finite, because it shows in the loss
    #: The shape that the engine expects of every output on a world; None: they differ, and checks of the kind look.
    shape: Callable[[World], tuple[int, ...]] | None = None


def behaviour_of(part: Part) -> Behaviour:
    """Return the behaviour of the part's kind."""
    found: Behaviour = importlib.import_module(f"gsstream.testing.{kind_of(part)}").BEHAVIOUR
    return found


def outputs(part: Part, world: World) -> Outputs:
    """Return the outputs of ``part`` on a world, tensor by tensor. Raises AssertionError for one of another shape."""
    behaviour = behaviour_of(part)
    found = behaviour.outputs(part, world)
    if behaviour.shape is not None:
        for name, value in found.items():
            has_shape(name, value, behaviour.shape(world))
    return found


def has_shape(what: str, value: torch.Tensor, want: tuple[int, ...]) -> None:
    """Raise AssertionError unless the shape is what is wanted, in the words in which a run refuses it."""
    assert tuple(value.shape) == want, f"{what}: expected shape {list(want)}, got {list(value.shape)}"


def draw(part: GateSampler, number: int, seed: int = 7) -> torch.Tensor | None:
    """Draw the noise of a gate from a fresh generator."""
    return part.noise(number, torch.Generator().manual_seed(seed))


def poisons_of(*paths: str, usual: tuple[float, float] = (0.75, 0.25)) -> tuple[Poison, ...]:
    """Return a poison of one value for each path of an array in a world, such as "gaussians.means"."""

    def put(path: str, world: World, value: float) -> None:
        array: Any = operator.attrgetter(path)(world)
        array.reshape(-1)[5] = value

    return tuple(
        Poison(f"one value of {path}", path.rpartition(".")[2], functools.partial(put, path), usual) for path in paths
    )
