"""A method as a run calls it: made of its parts, checked, within its budget, repeated where it fails."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

from gsstream.core.errors import ComponentError, ShapeError
from gsstream.core.frame import Frame
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.budget.controller import Controller
from gsstream.engine.method.checked import Checked
from gsstream.engine.method.parts import PartsMethod
from gsstream.engine.step.tools import RunTools
from gsstream.method.base import Step, StreamingMethod
from gsstream.method.tools import Tools
from gsstream.packet import PlayerState


class RepeatedFrameWarning(UserWarning):
    """A part failed, and its frame was sent as "nothing changed"."""


class SkippedWorkWarning(UserWarning):
    """A part failed in work that follows a frame's packet, which is sound and out; the work was left out."""


class Repeating(StreamingMethod[Any]):
    """Calls a method; where it fails, calls it again with the same frame and epoch scale 0.

    That call must be answered by an empty packet. A method that sends something else breaks its contract, and the
    failure is raised.
    """

    source = "gsstream"
    _method: StreamingMethod[Any]

    def __init__(self, method: StreamingMethod[Any]) -> None:
        super().__init__()
        vars(self).update(_method=method)

    def begin(self, frame: Frame, tools: Tools) -> Step[Any]:
        return self._method.begin(frame, tools)

    def step(self, state: Any, frame: Frame, tools: Tools) -> Step[Any]:
        mark = tools.log.mark()
        try:
            return self._method.step(state, frame, tools)
        except (ComponentError, ShapeError) as error:
            tools.log.give_up(error, mark)
            step = self._method.step(state, replace(frame, epoch_scale=0.0), tools)
            if step.status != "empty":
                raise
            warnings.warn(f"frame {frame.index} repeats the one before it: {error}", RepeatedFrameWarning, stacklevel=2)
            return step

    def follow_up(self, state: Any, step: Step[Any], frame: Frame, tools: Tools) -> Step[Any]:
        mark = tools.log.mark()
        try:
            return self._method.follow_up(state, step, frame, tools)
        except (ComponentError, ShapeError) as error:
            tools.log.give_up(error, mark)
            found = self._method.follow_up(state, step, replace(frame, epoch_scale=0.0), tools)
            warnings.warn(
                f"frame {frame.index}: its packet is sound, but the work that follows it failed and is left out: "
                f"{error}",
                SkippedWorkWarning,
                stacklevel=2,
            )
            return found

    def resume(self, player: PlayerState, shown: Frame, tools: Tools) -> Any:
        return self._method.resume(player, shown, tools)


class Budgeted(StreamingMethod[Any]):
    """Calls a method and lends it ``tools.budget``; the controller learns what its frames cost."""

    source = "gsstream"
    _method: StreamingMethod[Any]
    _controller: Controller

    def __init__(self, method: StreamingMethod[Any], controller: Controller) -> None:
        super().__init__()
        vars(self).update(_method=method, _controller=controller)

    def begin(self, frame: Frame, tools: Tools) -> Step[Any]:
        step = self._method.begin(frame, tools)
        self._controller.settle(frame.index, step.status, tools.log)
        return step

    def step(self, state: Any, frame: Frame, tools: Tools) -> Step[Any]:
        assert isinstance(tools, RunTools)
        budget = self._controller.allow(tools.log)
        if budget is None:
            return self._method.step(state, frame, tools)

        def refusal(number: int) -> str | None:
            return self._controller.key_refusal(number, budget)

        step = self._method.step(state, frame, replace(tools, budget=budget, key_refusal=refusal))
        self._controller.describe(budget, step, len(frame.cameras), tools.log)
        return step

    def follow_up(self, state: Any, step: Step[Any], frame: Frame, tools: Tools) -> Step[Any]:
        found = self._method.follow_up(state, step, frame, tools)
        self._controller.settle(frame.index, step.status, tools.log)
        return found

    def resume(self, player: PlayerState, shown: Frame, tools: Tools) -> Any:
        return self._method.resume(player, shown, tools)


def wrapped(assembly: Assembly, controller: Controller) -> StreamingMethod[Any]:
    """Return the method of a recipe behind what its recipe asks for; each wrapper is a method itself."""
    own = assembly.part("streaming_method")
    method: StreamingMethod[Any] = own.with_slots(assembly) if isinstance(own, PartsMethod) else own  # type: ignore[assignment]
    method = Checked(method, assembly)
    if controller.budget.limits_anything:
        method = Budgeted(method, controller)
    return Repeating(method) if assembly.recipe.stream.on_error == "repeat" else method
