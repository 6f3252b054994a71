"""Wrap a part so that its exceptions name slot, part and frame, and its outputs are checked."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from copy import copy
from functools import partial
from inspect import getattr_static
from pathlib import Path
from traceback import walk_tb
from typing import Any, TypeVar, cast

from gsstream.core.deferred import blaming
from gsstream.core.errors import ComponentError, GsstreamError, InputError, ShapeError
from gsstream.core.part import unwrapped
from gsstream.engine.assembly.checks import Checks, Look
from gsstream.engine.assembly.fault import Where, fault
from gsstream.engine.assembly.output_checks import OUTPUT_CHECKS
from gsstream.parts.backend.change import Change
from gsstream.parts.backend.row_optimiser import RowOptimiser
from gsstream.parts.render.session import RenderSession
from gsstream.parts.residual.optimiser import ResidualOptimiser

T = TypeVar("T")
#: Names of what parts open (sessions and changes of a renderer, residuals of an optimiser) in the table below and in
#: the table of checks. Errors about them name the part.
SESSION, RESIDUAL = "session", "residual"
OPENED: Mapping[str, type] = {SESSION: RenderSession, RESIDUAL: ResidualOptimiser, "change": Change}
#: What a renderer brings: attributes that stand behind a guard of their own, so that an error names them.
MEMBERS = ("loss", "optimiser")
#: Default bodies that call other functions of their object, by kind and name. With the level "step", and where the
#: object has no body of its own, they run on the guard, so that each of these calls is looked at.
BODIES: Mapping[tuple[str, str], Callable[..., Any]] = {
    (SESSION, "loss_and_grad"): RenderSession.loss_and_grad,
    ("renderer.optimiser", "residual_optimiser"): RowOptimiser.residual_optimiser,
    (RESIDUAL, "run"): ResidualOptimiser.run,
}


@contextmanager
def error_context(slot: str, part: object, where: Where) -> Iterator[None]:
    """Turn an error of a part into a ComponentError with slot, part, distribution, frame and iteration.

    A ShapeError is turned, too: it says that this part refuses what another part gave it. Of a renderer so is every
    InputError, because a renderer is given nothing but arrays. Other errors of gsstream pass unchanged.
    """
    try:
        with blaming(lambda: partial(_as_fault, slot, part, copy(where))):
            yield
    except GsstreamError as error:
        if isinstance(error, ShapeError) or (slot == "renderer" and isinstance(error, InputError)):
            raise fault(str(error), slot, part, where) from error
        raise
    except Exception as error:
        raise fault(f"{type(error).__name__}: {error}{line_of(error, part)}", slot, part, where) from error


def _as_fault(slot: str, part: object, where: Where, error: Exception) -> Exception:
    return error if isinstance(error, ComponentError) else fault(str(error), slot, part, where)


def line_of(error: Exception, part: object) -> str:
    """The line of the part's own package that was being run, as `` (gate.py:42)``."""
    package = type(part).__module__.partition(".")[0]
    found = ""
    for frame, line in walk_tb(error.__traceback__):
        if str(frame.f_globals.get("__name__", "")).partition(".")[0] == package:
            found = f" ({Path(frame.f_code.co_filename).name}:{line})"
    return found


class Guarded:
    """Stands in the place of a part: errors of the part name the part, and values that it returns are checked."""

    def __init__(self, slot: str, part: object, where: Where, level: Checks, kind: str = "") -> None:
        self._slot, self._part, self._where, self._level = slot, part, where, level
        self._subject, self._kind = part, kind or slot

    @classmethod
    def opened(cls, result: object, slot: str, part: object, where: Where, level: Checks) -> object:
        """Return what a part opened behind a guard that names the part; return any other result as it is."""
        kind = next((name for name, opened in OPENED.items() if isinstance(result, opened)), None)
        if kind is None:
            return result
        made = cls(slot, part, where, level, kind)
        made._subject = result
        return made

    @property
    def __wrapped__(self) -> object:
        """The part itself (``gsstream.core.part.unwrapped``)."""
        return self._subject

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        body = BODIES.get((self._kind, name))
        if body is not None and (self._level is Checks.STEP or getattr(type(self._subject), name, None) is body):
            # Never kept in ``__dict__``: a guard that holds itself would keep a render of every camera alive.
            return partial(self._on_guard, body)
        value = self._value(name)
        if self._kind == "renderer" and name in MEMBERS:
            return Guarded(f"renderer.{name}", value, self._where, self._level)
        if not callable(value) or isinstance(value, type):
            return value
        call = self._guarding(name, value)
        self.__dict__[name] = call
        return call

    def _on_guard(self, body: Callable[..., Any], *args: Any, **kwargs: Any) -> object:
        return Guarded.opened(body(self, *args, **kwargs), self._slot, self._part, self._where, self._level)

    def _value(self, name: str) -> Any:
        """Return an attribute of the part; an error in a property is a failure of the part like any other."""
        try:
            return getattr(self._subject, name)
        except Exception as error:
            if isinstance(error, AttributeError) and getattr_static(self._subject, name, None) is None:
                raise  # the part has no such attribute, which the caller may test for
            with error_context(self._slot, self._part, self._where):
                raise

    def _guarding(self, name: str, method: Callable[..., Any]) -> Callable[..., Any]:
        # No reference to ``self`` here: ``self`` holds what is returned, and a cycle would keep a session, which has
        # the memory of a render for every camera, until the garbage collector runs.
        slot, part, where, level, kind = self._slot, self._part, self._where, self._level, self._kind
        look = OUTPUT_CHECKS.get((kind, name))
        looking = Look(level, slot, part, where)

        def call(*args: Any, **kwargs: Any) -> Any:
            with error_context(slot, part, where):
                result = method(*args, **kwargs)
                if name == "propose":
                    where.pause()  # the part's own iterations are over: an error about its result names none
                if look is not None:
                    look(looking, args, result)
            return Guarded.opened(result, slot, part, where, level)

        return call

    def __eq__(self, other: object) -> bool:
        return bool(self._subject == (other._subject if isinstance(other, Guarded) else other))

    def __hash__(self) -> int:
        return hash(self._subject)

    def __repr__(self) -> str:
        return repr(self._subject)


def guard(slot: str, part: T, where: Where, level: Checks) -> T:
    """Return the part behind a guard; one that is guarded already gets this place and this level."""
    return cast(T, Guarded(slot, unwrapped(part), where, level))
