"""A part while a run calls it: where the run is, the errors about the part, and the checks of what it returns."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import entry_points, packages_distributions
from pathlib import Path
from traceback import walk_tb

import torch

from gsstream.core.deferred import MakeError, named_checks, require
from gsstream.core.errors import STRANGERS, ComponentError, GsstreamError, InputError, ShapeError
from gsstream.engine.assembly.checks import Checks
from gsstream.spec import ENTRY_POINT_GROUP

_MOST = torch.finfo(torch.float32).max
_EVERYTHING = (-_MOST, _MOST)


@dataclass
class Where:
    """The frame and the iteration in which parts are being called; None outside of them. One for all parts of a run."""

    frame: int | None = None
    iteration: int | None = None

    def enter(self, frame: int | None) -> None:
        """Note that a frame begins; its first iteration has not begun."""
        self.frame, self.iteration = frame, None

    def iterate(self, first: int, place: int) -> None:
        """Begin the iteration at this place of a series, of which the first has the number ``first``."""
        self.iteration = first + place

    def count(self) -> None:
        """Begin the next iteration of a part that fits something itself: the first is 1."""
        self.iteration = 1 if self.iteration is None else self.iteration + 1

    def pause(self) -> None:
        """Note that the iterations of a part have ended."""
        self.iteration = None


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

        A ShapeError is turned, too: it says that this part refuses what another part gave it. Every InputError of a
        renderer is turned, too, because a renderer is given nothing but arrays. Other errors of gsstream pass
        unchanged.
        """
        try:
            with named_checks(self._named):
                yield
        except GsstreamError as error:
            if isinstance(error, ShapeError) or (self.slot == "renderer" and isinstance(error, InputError)):
                raise self.fault(str(error)) from error
            raise
        except STRANGERS as error:
            raise self.fault(f"{type(error).__name__}: {error}{line_of(error, self.part)}") from error

    def _named(self, error: MakeError) -> MakeError:
        """Makes the error of a check that is read later one about this part, at the present place."""
        return partial(_as_fault, replace(self, where=copy(self.where)), error)

    def output(
        self, what: str, value: object, shape: tuple[int, ...], limits: tuple[float, float] | None = None
    ) -> None:
        """Raise ComponentError unless ``value`` is a finite tensor of float32 of this shape, within ``limits``.

        Type and shape are always looked at; numbers once per frame, and with the level "step" in every iteration.
        """
        if not isinstance(value, torch.Tensor) or value.dtype != torch.float32:
            got = str(value.dtype) if isinstance(value, torch.Tensor) else type(value).__name__
            raise self.fault(f"{what}: expected a tensor of torch.float32, got {got}")
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
        return ComponentError(
            message,
            slot=self.slot,
            part=type(self.part).__name__,
            distribution=_distribution(type(self.part).__module__.partition(".")[0]),
            frame=self.where.frame,
            iteration=self.where.iteration,
        )


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


def line_of(error: BaseException, part: object) -> str:
    """Return the line of the part's own package that was being run, as `` (gate.py:42)``."""
    package = type(part).__module__.partition(".")[0]
    found = ""
    for frame, line in walk_tb(error.__traceback__):
        if str(frame.f_globals.get("__name__", "")).partition(".")[0] == package:
            found = f" ({Path(frame.f_code.co_filename).name}:{line})"
    return found


def _distribution(package: str) -> str:
    """Return the distribution of a top-level package. Entry points are asked first: editable installs list no files."""
    for point in entry_points(group=ENTRY_POINT_GROUP):
        if point.dist is not None and point.module.partition(".")[0] == package:
            return point.dist.name
    return packages_distributions().get(package, [package])[0]
