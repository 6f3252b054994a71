"""Comparisons that fail with numbers: largest deviation, where, what was expected, and where the tolerance is from.

Also how the engine calls a part of each kind, and how the outputs of two calls are compared.
"""

from __future__ import annotations

import functools
import importlib
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch

from gsstream.core.part import Part
from gsstream.parts.gate.base import GateSampler
from gsstream.testing.cases import World
from gsstream.testing.registry import kind_of

EXACT = "bitwise: the same operations on the same numbers"
ROUNDING = "float32 rounding over a few hundred terms"
#: Tolerance as a share of the largest gradient of a scene. A gradient that is smaller than this share all over, such as
#: the gradient of the rotation of round Gaussians, is the rest of large terms that cancel: its digits are rounding.
FLOOR = 0.01


def equal(what: str, got: torch.Tensor, expected: torch.Tensor, tolerance: float = 0.0, why: str = EXACT) -> None:
    """Raise AssertionError unless shape and dtype agree and no value is farther off than ``tolerance``.

    ``tolerance`` is absolute up to a magnitude of 1 and relative above; ``why`` says why it is what it is.
    """
    assert got.shape == expected.shape, f"{what}: expected shape {list(expected.shape)}, got {list(got.shape)}"
    assert got.dtype == expected.dtype, f"{what}: expected {expected.dtype}, got {got.dtype}"
    if got.numel() == 0:
        return
    off = (got.double() - expected.double()).abs() / expected.double().abs().clamp_min(1.0)
    same = (got == expected) | (torch.isnan(got.double()) & torch.isnan(expected.double()))
    off = torch.where(same, torch.zeros_like(off), torch.where(torch.isnan(off), torch.full_like(off, torch.inf), off))
    worst = int(off.flatten().argmax())
    assert float(off.flatten()[worst]) <= tolerance, (
        f"{what}: largest deviation {float(off.flatten()[worst]):.3g} at flat index {worst}: expected "
        f"{expected.flatten()[worst].item()!r}, got {got.flatten()[worst].item()!r} "
        f"(tolerance {tolerance:g}: {why})"
    )


def all_equal(
    what: str,
    got: Mapping[str, torch.Tensor],
    expected: Mapping[str, torch.Tensor],
    tolerance: float = 0.0,
    why: str = EXACT,
) -> None:
    """Apply :func:`equal` to every named tensor; the names must agree too."""
    assert set(got) == set(expected), f"{what}: expected the outputs {sorted(expected)}, got {sorted(got)}"
    for name, value in expected.items():
        equal(f"{what}: {name}", got[name], value, tolerance=tolerance, why=why)


def relative(what: str, got: torch.Tensor, expected: torch.Tensor, tolerance: float, why: str, *, floor: float) -> None:
    """Apply :func:`equal` to fractions of the largest expected value, which is taken to be at least ``floor``."""
    assert floor > 0, f"{what}: expected a floor above 0, got {floor}"
    scale = max(float(expected.abs().max()), floor) if expected.numel() else 1.0
    equal(f"{what}, as fractions of {scale:.3g}", got / scale, expected / scale, tolerance=tolerance, why=why)


def gradients_equal(
    what: str, got: Mapping[str, torch.Tensor], expected: Mapping[str, torch.Tensor], tolerance: float, why: str
) -> None:
    """Apply :func:`relative` to every gradient of a scene, each with the same floor; the names must agree too."""
    assert set(got) == set(expected), f"{what}: expected gradients of {sorted(expected)}, got {sorted(got)}"
    largest = max(float(value.abs().max()) for value in expected.values() if value.numel())
    assert largest > 0, f"{what}: every expected gradient is 0, so nothing would be compared"
    for name, value in expected.items():
        relative(f"{what}: gradient of {name}", got[name], value, tolerance=tolerance, why=why, floor=FLOOR * largest)


def at_most(what: str, got: torch.Tensor, bound: torch.Tensor | float, tolerance: float, why: str) -> None:
    """Raise AssertionError unless every value is <= ``bound`` + ``tolerance``; NaN never is."""
    if got.numel() == 0:
        return
    limit = torch.as_tensor(bound, dtype=torch.float64).expand(got.shape)
    over = got.double() - limit
    bad = ~(over <= tolerance)
    if not bool(bad.any()):
        return
    worst = int(torch.where(torch.isnan(over), torch.full_like(over, torch.inf), over).flatten().argmax())
    raise AssertionError(
        f"{what}: {int(bad.sum())} of {got.numel()} values exceed their bound, worst at flat index {worst}: "
        f"expected at most {limit.flatten()[worst].item():.6g}, got {got.flatten()[worst].item():.6g} "
        f"(tolerance {tolerance:g}: {why})"
    )


def finite(what: str, value: torch.Tensor) -> None:
    """Raise AssertionError naming the first value that is not finite."""
    bad = (~torch.isfinite(value)).nonzero()
    assert len(bad) == 0, (
        f"{what}: expected finite values, got {value[tuple(bad[0])].item()} at index {bad[0].tolist()} "
        f"({len(bad)} of {value.numel()} values are not finite)"
    )


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
