"""Wrap a part so that its exceptions name slot, part and frame, and its outputs are checked."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from inspect import getattr_static
from typing import Any, TypeVar, cast

from gsstream.core.part import unwrapped
from gsstream.engine.assembly.checks import Checks
from gsstream.engine.assembly.output_checks import OUTPUT_CHECKS
from gsstream.engine.assembly.part_in_use import PartInUse, Where
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


class Guarded:
    """Stands in the place of a part: errors of the part name the part, and values that it returns are checked."""

    def __init__(self, subject: object, kind: str, use: PartInUse) -> None:
        self._subject, self._kind, self._use = subject, kind, use

    @property
    def __wrapped__(self) -> object:
        """The part itself (``gsstream.core.part.unwrapped``)."""
        return self._subject

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        body, use = BODIES.get((self._kind, name)), self._use
        if body is not None and (use.level is Checks.STEP or getattr(type(self._subject), name, None) is body):
            # Never kept in ``__dict__``: a guard that holds itself would keep a render of every camera alive.
            return partial(self._on_guard, body)
        try:
            value = getattr(self._subject, name)
        except Exception as error:
            if isinstance(error, AttributeError) and getattr_static(self._subject, name, None) is None:
                raise  # the part has no such attribute, which the caller may test for
            with use.errors():  # an error in a property is a failure of the part like any other
                raise
        if self._kind == "renderer" and name in MEMBERS:
            member = f"renderer.{name}"
            return Guarded(value, member, PartInUse(member, value, use.where, use.level))
        if not callable(value) or isinstance(value, type):
            return value
        call = _guarded_call(value, name, OUTPUT_CHECKS.get((self._kind, name)), use)
        self.__dict__[name] = call
        return call

    def _on_guard(self, body: Callable[..., Any], *args: Any, **kwargs: Any) -> object:
        return _guarded_result(body(self, *args, **kwargs), self._use)

    def __eq__(self, other: object) -> bool:
        return bool(self._subject == (other._subject if isinstance(other, Guarded) else other))

    def __hash__(self) -> int:
        return hash(self._subject)

    def __repr__(self) -> str:
        return repr(self._subject)


def _guarded_call(
    method: Callable[..., Any], name: str, check: Callable[..., None] | None, use: PartInUse
) -> Callable[..., Any]:
    # Without the guard itself, which holds what is returned: a cycle would keep a session, which has the memory of a
    # render for every camera, until the garbage collector runs.
    def call(*args: Any, **kwargs: Any) -> Any:
        with use.errors():
            result = method(*args, **kwargs)
            if name == "propose":
                use.where.pause()  # the part's own iterations are over: an error about its result names none
            if check is not None:
                check(use, args, result)
        return _guarded_result(result, use)

    return call


def _guarded_result(result: object, use: PartInUse) -> object:
    """Return what a part opened behind a guard that names the part; return any other result as it is."""
    for kind, opened in OPENED.items():
        if isinstance(result, opened):
            return Guarded(result, kind, use)
    return result


def guard(slot: str, part: T, where: Where, level: Checks) -> T:
    """Return the part behind a guard; one that is guarded already gets this place and this level."""
    bare = unwrapped(part)
    return cast(T, Guarded(bare, slot, PartInUse(slot, bare, where, level)))
