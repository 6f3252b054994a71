"""Wrap a part so that its exceptions name slot, part and frame, and its outputs are checked."""

# ruff: noqa: ARG001  # a table of functions with one signature

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from inspect import getattr_static
from typing import Any, TypeVar, cast

import torch

from gsstream.core.changes import Field, Motion, RowEdit
from gsstream.core.errors import STRANGERS
from gsstream.core.part import unwrapped
from gsstream.engine.assembly.checks import UNIT, Checks
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


def _estimate(use: PartInUse, args: tuple[Any, ...], result: object) -> None:
    use.output("estimate()", result, (args[0].hierarchy.num_gaussians,))


def _propagate(use: PartInUse, args: tuple[Any, ...], result: object) -> None:
    use.output("propagate()", result, (args[1].num_nodes,))


def _like_logits(what: str, limits: tuple[float, float] | None) -> Callable[[PartInUse, tuple[Any, ...], object], None]:
    def check(use: PartInUse, args: tuple[Any, ...], result: object) -> None:
        use.output(what, result, tuple(args[0].shape), limits)

    return check


def _penalty(use: PartInUse, args: tuple[Any, ...], result: Mapping[str, torch.Tensor]) -> None:
    use.terms(result)


def _motion(use: PartInUse, args: tuple[Any, ...], result: object) -> None:
    if not isinstance(result, tuple) or not all(isinstance(motion, Motion | Field) for motion in result):
        raise use.fault(f"propose(): expected a tuple of Motion or Field, got {type(result).__name__}")


def _growth(use: PartInUse, args: tuple[Any, ...], result: object) -> None:
    if result is not None and not isinstance(result, RowEdit):
        raise use.fault(f"propose(): expected RowEdit or None, got {type(result).__name__}")
    if result is not None and result.added is not None:
        for name, value in result.added.gaussians.items():
            use.values(f"added: {name}", torch.as_tensor(value))


def _image(use: PartInUse, args: tuple[Any, ...], result: Any) -> None:
    if use.level is Checks.STEP:
        view = next((arg for arg in args if isinstance(arg, int)), None)
        use.values("image" if view is None else f"image of view {view}", result.image)


def _loss(use: PartInUse, args: tuple[Any, ...], result: Any) -> None:
    if use.level is Checks.STEP:
        use.values("loss", result[0])
        use.values("gradient of the image", result[1])


def _optimiser(use: PartInUse, args: tuple[Any, ...], result: object) -> None:
    use.step_values("after the step,", args[0])


#: What is checked of the result of each call of a part: one entry per kind and function, and no checks elsewhere.
OUTPUT_CHECKS: Mapping[tuple[str, str], Callable[[PartInUse, tuple[Any, ...], Any], None]] = {
    ("confidence", "estimate"): _estimate,
    ("propagation", "propagate"): _propagate,
    ("gate", "init"): _like_logits("init()", None),
    ("gate", "sample"): _like_logits("sample()", UNIT),
    ("gate", "open_probability"): _like_logits("open_probability()", UNIT),
    ("gate", "bound"): _like_logits("bound()", None),
    ("regularizer", "penalty"): _penalty,
    ("motion", "propose"): _motion,
    ("growth", "propose"): _growth,
    ("renderer", "render"): _image,
    ("session", "render"): _image,
    ("renderer.loss", "evaluate"): _loss,
    ("renderer.optimiser", "step"): _optimiser,
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
        except STRANGERS as error:
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
