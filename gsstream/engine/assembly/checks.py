"""How strictly a run checks the values that parts return: off, frame or step (``GSSTREAM_CHECKS``).

Nothing that is sent depends on the level: it decides when a wrong number is noticed, and how precisely it is named.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import partial

import torch

from gsstream.core.deferred import require
from gsstream.core.errors import InputError
from gsstream.engine.assembly.fault import Where, fault

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
class Look:
    """Checks the values that one part returned."""

    level: Checks  # how closely
    #: slot, part: whose it is.
    slot: str
    part: object
    where: Where  # the frame and iteration that an error names

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
        if self.looks(least):
            self.values(what, value, limits=limits)

    def looks(self, least: Checks) -> bool:
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

    def fault(self, message: str) -> Exception:
        """Return the error about this part, here and now."""
        return fault(message, self.slot, self.part, self.where)


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
