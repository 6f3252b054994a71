"""A method under a budget: what each frame may cost is planned before it, lent to the method, and written down."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from gsstream.core.frame import Frame
from gsstream.engine.budget.controller import Controller
from gsstream.engine.step.tools import RunTools
from gsstream.method.base import Step, StreamingMethod
from gsstream.method.tools import Tools
from gsstream.packet import PlayerState


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
