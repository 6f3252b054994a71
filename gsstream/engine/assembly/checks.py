"""How closely a run looks at what parts return: off, frame or step (``GSSTREAM_CHECKS``, ``gsstream run --checks``).

Nothing that is sent depends on the level: it decides when a wrong number is noticed, and how precisely it is named.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from enum import StrEnum

import torch

from gsstream.core.errors import InputError
from gsstream.core.gaussians import Gaussians
from gsstream.core.part import Part
from gsstream.engine.assembly.guard import fault

VARIABLE = "GSSTREAM_CHECKS"
UNIT = (0.0, 1.0)
_MOST = torch.finfo(torch.float32).max
_EVERYTHING = (-_MOST, _MOST)


class Checks(StrEnum):
    """Levels of looking; each looks at all that the one before it does.

    off: types and shapes at the seams alone. frame: also every number that crosses a seam, once per frame, the penalty
    in every iteration (the default). step: also gates, rows, images, losses, gradients and parameters in every
    iteration.
    """

    OFF = "off"
    FRAME = "frame"
    STEP = "step"


def wanted_checks(given: str | None = None) -> Checks:
    """The level asked for: ``given``, else that of the environment, else "frame".

    Raises InputError for anything but the three levels.
    """
    where = "--checks" if given is not None else VARIABLE
    text = given if given is not None else os.environ.get(VARIABLE, "") or Checks.FRAME
    try:
        return Checks(text)
    except ValueError:
        known = ", ".join(Checks)
        raise InputError(f"{where}: expected one of {known}, got {text!r}") from None


def check_output(
    level: Checks,
    slot: str,
    part: Part,
    frame: int | None,
    what: str,
    value: object,
    shape: tuple[int, ...],
    limits: tuple[float, float] | None = None,
) -> None:
    """Raise ComponentError unless ``value`` is a finite floating point tensor of this shape, within ``limits``.

    Once per frame and seam: what a part gets wrong is said with its name, before another part stumbles over it. With
    the level "off" only type and shape are looked at.
    """
    if not isinstance(value, torch.Tensor) or not value.dtype.is_floating_point:
        got = str(value.dtype) if isinstance(value, torch.Tensor) else type(value).__name__
        raise fault(f"{what}: expected a floating point tensor, got {got}", slot, part, frame)
    if tuple(value.shape) != shape:
        raise fault(f"{what}: expected shape {list(shape)}, got {list(value.shape)}", slot, part, frame)
    if level is not Checks.OFF:
        check_values(slot, part, what, value, frame, limits=limits)


def check_terms(level: Checks, part: Part, frame: int, iteration: int, terms: Mapping[str, torch.Tensor]) -> None:
    """Raise ComponentError unless every term of a penalty is one number; except with "off", a finite one."""
    for name, value in terms.items():
        if value.numel() != 1 or not (level is Checks.OFF or bool(torch.isfinite(value).all())):
            got = float(value) if value.numel() == 1 else f"shape {list(value.shape)}"
            message = f"penalty {name!r}: expected one finite number, got {got}"
            raise fault(message, "regularizer", part, frame, iteration)


def check_values(
    slot: str,
    part: object,
    what: str,
    value: torch.Tensor,
    frame: int | None,
    iteration: int | None = None,
    *,
    limits: tuple[float, float] | None = None,
    rows: torch.Tensor | None = None,
) -> None:
    """Raise ComponentError unless every number is finite and within ``limits``; the first that is not is named.

    One pass without temporary memory when all is well.

    Arguments:
        rows: [A] rows of the scene that ``value`` [A, ...] is about, so that the Gaussian can be named.
    """
    if value.numel() == 0:
        return
    value = value.detach()
    low, high = torch.aminmax(value)
    least, most = _EVERYTHING if limits is None else limits
    if least <= float(low) and float(high) <= most:  # false for NaN, which aminmax passes on
        return
    bad = ~torch.isfinite(value)
    wanted = "finite values"
    if limits is not None:
        bad |= (value < least) | (value > most)
        wanted += f" from {least:g} to {most:g}"
    index = tuple(bad.nonzero()[0].tolist())
    place = f"index {list(index)}"
    if rows is not None:
        place += f" (Gaussian {int(rows[index[0]])})"
    message = f"{what}: expected {wanted}, got {float(value[index])!r} at {place}"
    raise fault(f"{message} ({int(bad.sum())} of {bad.numel()} values)", slot, part, frame, iteration)


class StepChecks:
    """What is looked at in every iteration: everything it is called with at the level step, nothing below it."""

    __slots__ = ("frame", "iteration", "on")

    def __init__(self, level: Checks, frame: int) -> None:
        self.on, self.frame, self.iteration = level is Checks.STEP, frame, 0

    def __call__(
        self,
        slot: str,
        part: object,
        what: str,
        value: torch.Tensor | Gaussians[torch.Tensor] | Mapping[str, torch.Tensor],
        limits: tuple[float, float] | None = None,
        rows: torch.Tensor | None = None,
    ) -> None:
        """:func:`check_values` on a tensor, or on each of several, whose name then follows ``what``."""
        if not self.on:
            return
        named = {what: value} if isinstance(value, torch.Tensor) else {f"{what} {n}": v for n, v in value.items()}
        for name, tensor in named.items():
            check_values(slot, part, name, tensor, self.frame, self.iteration, limits=limits, rows=rows)

    def gradients(
        self, slot: str, part: object, what: str, leaves: Gaussians[torch.Tensor], rows: torch.Tensor | None = None
    ) -> None:
        """The same on the gradients that wait on leaves; a leaf that nothing reached has none."""
        if self.on:
            found = {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
            self(slot, part, what, found, rows=rows)

    def number(self, slot: str, part: object, what: str, value: float) -> None:
        """The same on one number."""
        if self.on:
            self(slot, part, what, torch.tensor(value, dtype=torch.float64))
