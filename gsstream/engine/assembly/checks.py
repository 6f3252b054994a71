"""How strictly a run checks the values that parts return: off, frame or step (``GSSTREAM_CHECKS``).

Nothing that is sent depends on the level: it decides when a wrong number is noticed, and how precisely it is named.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial

import torch

from gsstream.core.deferred import MakeError, named_checks, require
from gsstream.core.errors import ComponentError, GsstreamError, InputError, ShapeError
from gsstream.engine.assembly.fault import Where, fault, line_of

VARIABLE = "GSSTREAM_CHECKS"
UNIT = (0.0, 1.0)
_MOST = torch.finfo(torch.float32).max
_EVERYTHING = (-_MOST, _MOST)


class Checks(StrEnum):
    """Levels of looking; each looks at all that the one before it does.

    off: types and shapes at the seams alone. frame: also every number that crosses a seam, once per frame, the penalty
    in every iteration (the default). step: also gates, images, losses, gradients and parameters in every iteration.
    """

    OFF = "off"
    FRAME = "frame"
    STEP = "step"


def requested_checks(given: str | None = None) -> Checks:
    """Return the level ``given``, else that of the environment, else "frame". Raises InputError for any other."""
    where = "checks" if given is not None else VARIABLE
    text = given if given is not None else os.environ.get(VARIABLE, "") or Checks.FRAME
    try:
        return Checks(text)
    except ValueError:
        known = ", ".join(Checks)
        raise InputError(f"{where}: expected one of {known}, got {text!r}") from None


@dataclass(frozen=True, slots=True)
class PartInUse:
    """A part in its slot, while a run calls it: makes the errors about the part, and checks the values it returns."""

    slot: str
    part: object
    where: Where  # the frame and iteration that an error names
    level: Checks  # how closely values are looked at

    @contextmanager
    def errors(self) -> Iterator[None]:
        """Turn an error of the part into a ComponentError with slot, part, distribution, frame and iteration.

        A ShapeError is turned, too: it says that this part refuses what another part gave it. Of a renderer so is every
        InputError, because a renderer is given nothing but arrays. Other errors of gsstream pass unchanged.
        """
        try:
            with named_checks(self._named):
                yield
        except GsstreamError as error:
            if isinstance(error, ShapeError) or (self.slot == "renderer" and isinstance(error, InputError)):
                raise self.fault(str(error)) from error
            raise
        except Exception as error:
            raise self.fault(f"{type(error).__name__}: {error}{line_of(error, self.part)}") from error

    def _named(self, error: MakeError) -> MakeError:
        """Makes the error of a check that is read later one about this part, at the present place."""
        return partial(_as_fault, replace(self, where=copy(self.where)), error)

    def output(
        self, what: str, value: object, shape: tuple[int, ...], limits: tuple[float, float] | None = None
    ) -> None:
        """Raise ComponentError unless ``value`` is a finite floating point tensor of this shape, within ``limits``.

        Type and shape are always looked at; numbers once per frame, and with the level "step" in every iteration.
        """
        if not isinstance(value, torch.Tensor) or not value.dtype.is_floating_point:
            got = str(value.dtype) if isinstance(value, torch.Tensor) else type(value).__name__
            raise self.fault(f"{what}: expected a floating point tensor, got {got}")
        if tuple(value.shape) != shape:
            raise self.fault(f"{what}: expected shape {list(shape)}, got {list(value.shape)}")
        least = Checks.FRAME if self.where.iteration is None else Checks.STEP
        if self.is_level(least):
            self.values(what, value, limits=limits)

    def is_level(self, least: Checks) -> bool:
        """Say whether the level is at least this one."""
        order = list(Checks)
        return order.index(self.level) >= order.index(least)

    def step_values(self, what: str, values: Mapping[str, torch.Tensor]) -> None:
        """Check each of several tensors with the level "step"; their names follow ``what`` in errors."""
        if self.level is Checks.STEP:
            for name, tensor in values.items():
                self.values(f"{what} {name}", tensor)

    def values(
        self,
        what: str,
        value: torch.Tensor,
        *,
        limits: tuple[float, float] | None = None,
        rows: torch.Tensor | None = None,
    ) -> None:
        """Raise ComponentError unless every number is finite and within ``limits``; the first that is not is named.

        One pass without temporary memory when all is well.
        """
        if self.level is Checks.OFF:
            return
        if value.device.type == "cpu":
            problem = wrong_value(value, limits, rows)
            if problem:
                raise self.fault(f"{what}: {problem}")
        elif value.numel():
            low, high = torch.aminmax(value.detach())
            least, most = _EVERYTHING if limits is None else limits
            require(
                (low >= least) & (high <= most),
                lambda: self.fault(f"{what}: {wrong_value(value.cpu(), limits, None if rows is None else rows.cpu())}"),
            )

    def terms(self, terms: Mapping[str, torch.Tensor]) -> None:
        """Raise ComponentError unless every term of a penalty is one number; except with "off", a finite one."""
        for name, value in terms.items():
            if value.numel() != 1:
                raise self.fault(f"penalty {name!r}: expected one finite number, got shape {list(value.shape)}")
            if self.level is not Checks.OFF:
                require(value.detach().abs() <= _MOST, partial(self._not_finite, name, value))

    def _not_finite(self, name: str, value: torch.Tensor) -> Exception:
        return self.fault(f"penalty {name!r}: expected one finite number, got {float(value)}")

    def fault(self, message: str) -> ComponentError:
        """Return the error about this part, here and now."""
        return fault(message, self.slot, self.part, self.where)


def _as_fault(use: PartInUse, error: MakeError) -> Exception:
    found = error()
    if isinstance(found, ComponentError):
        return found
    named = use.fault(str(found))
    named.__cause__ = found
    return named


def wrong_value(
    value: torch.Tensor, limits: tuple[float, float] | None = None, rows: torch.Tensor | None = None
) -> str:
    """Say which number is not finite or not within the limits; empty when all are."""
    if value.numel() == 0:
        return ""
    value = value.detach()
    low, high = torch.aminmax(value)
    least, most = _EVERYTHING if limits is None else limits
    if least <= float(low) and float(high) <= most:  # false for NaN, which aminmax passes on
        return ""
    bad = ~torch.isfinite(value)
    wanted = "finite values"
    if limits is not None:
        bad |= (value < least) | (value > most)
        wanted += f" from {least:g} to {most:g}"
    index = tuple(bad.nonzero()[0].tolist())
    place = f"index {list(index)}"
    if rows is not None:
        place += f" (Gaussian {int(rows[index[0]])})"
    return f"expected {wanted}, got {float(value[index])!r} at {place} ({int(bad.sum())} of {bad.numel()} values)"
