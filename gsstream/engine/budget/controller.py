"""The controller of a run: a plan before every frame, and after it what it cost, what bound and what was given up.

Its memory is the run's ``metrics.jsonl`` alone, so a resumed run plans as the first would have.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from gsstream.core.kinds import FITTING_SLOTS
from gsstream.core.log import FrameLog
from gsstream.engine.budget.plan import WINDOW, Past, plan, read_past_frame, unlimited
from gsstream.method.base import Step
from gsstream.method.budget import FrameBudget
from gsstream.metrics import peak_memory_mb
from gsstream.recipe.budget import Budget
from gsstream.recipe.model import Stream


class Controller:
    """Plans frames of one run and writes down what became of the plans; a run without a budget has none."""

    def __init__(self, budget: Budget, stream: Stream) -> None:
        self.budget, self._stream, self._unlimited = budget, stream, unlimited(stream)
        self._history: tuple[Past, ...] = ()
        self._key: tuple[float, float] | None = None

    def remember(self, lines: Iterable[Mapping[str, Any]]) -> None:
        """Go on after these lines of ``metrics.jsonl``."""
        for line in lines:
            self._note(line)

    def allow(self, log: FrameLog, first: bool = False) -> FrameBudget:
        """Return what the frame of this log may spend; a stream's first, from which all starts, has no limit."""
        if first or not self.budget.limits_frames:
            return self._unlimited
        clock = time.perf_counter
        return replace(plan(self.budget, self._stream, self._history), started=clock() - log.elapsed(), clock=clock)

    def key_refusal(self, allowed: FrameBudget, num_gaussians: int) -> str | None:
        """Say why a key packet that is due must wait, by what the last one cost; None: it may be tried."""
        if self._key is None or not allowed.is_limited:
            return None
        size, seconds = (value * num_gaussians for value in self._key)
        if self.budget.size is not None and 0.9 * size > self.budget.size:
            return f"about {size:.0f} bytes where {self.budget.size} are allowed"
        if self.budget.time is not None and allowed.clock() - allowed.started + seconds > self.budget.time:
            return f"about {seconds:.2f} s where {self.budget.time:g} s are allowed for the frame"
        return None

    def settle(self, step: Step[Any], allowed: FrameBudget, views: int, log: FrameLog, idle: float = 0.0) -> None:
        """Log what a finished frame cost, what bound it and what it gave up, and plan with that from then on.

        Arguments:
            step: result of the frame.
            allowed: what :meth:`allow` returned for it.
            views: training cameras, an iteration for each of which is an epoch.
            log: its log. A method that has made iterations, or has logged its own use as ``budget``, is described by
                that, or else by its phases and the size of its packet.
            idle: seconds of it in which the encoder would have waited for the next frame.
        """
        numbers, seconds, entry = log.numbers, log.elapsed() - idle, dict[str, Any]()
        actual = {"time": seconds, "size": len(step.packet.data), "memory": 1e6 * peak_memory_mb()}
        known = actual if allowed.is_limited else ("memory",)
        limits = {name: limit for name in known if (limit := getattr(self.budget, name)) is not None}
        if allowed.is_limited and (numbers.get("iterations") or "budget" in numbers):
            used = {**(numbers.get("budget") or _phases(step, allowed, log)), "parts": log.seconds(*FITTING_SLOTS)}
            entry = spent(allowed, used, self._stream, numbers.get("iterations", 0) / views)
            entry["usage"]["seconds"] = seconds
        entry["limits"] = limits
        entry["actual"] = {name: actual[name] for name in limits}
        entry["violated"] = [name for name, limit in limits.items() if actual[name] > limit]
        log.set(budget=entry)
        # The line is noted as it will be read back: a resumed run must plan with the same numbers.
        self._note(json.loads(json.dumps({"frame": step.packet.frame, "status": step.status, **log.entry()})))

    def _note(self, metrics: Mapping[str, Any]) -> None:
        if metrics["status"] == "key" and metrics["num_gaussians"]:
            size = sum(metrics["bytes"].values())
            seconds = metrics["seconds"].get("key", metrics["seconds"].get("code", 0.0))
            self._key = size / metrics["num_gaussians"], seconds / metrics["num_gaussians"]
        past = read_past_frame(metrics)
        if past is not None:
            self._history = (*self._history, past)[-WINDOW:]


def _phases(step: Step[Any], allowed: FrameBudget, log: FrameLog) -> dict[str, Any]:
    """The seconds and bytes that a frame used, read from its phases and its packet."""
    return {
        "rd_lambda": allowed.rd_lambda,
        "estimate": 0.0,
        "stopped_by_clock": False,
        "untrimmed": len(step.packet.data),
        "dropped": {},
        "before": log.seconds("change", "motion", "confidence"),
        "optimise": log.seconds("optimise"),
    }


def spent(plan: FrameBudget, used: Mapping[str, Any], stream: Stream, epochs: float) -> dict[str, Any]:
    """Return the entry ``budget`` of a frame, before its limits and the cost of the whole frame are added.

    ``used`` is what :meth:`EpochScheduler.usage` returns, with the seconds of parts that fit by themselves as
    ``parts``;
    ``stream`` holds the recipe's own settings, from which the plan departed.
    """
    reduced: dict[str, Any] = {}
    if plan.max_bytes is not None:
        if used["rd_lambda"] > 1.05 * stream.rd_lambda:
            reduced["rd_lambda"] = [stream.rd_lambda, used["rd_lambda"]]
        if plan.step_scale > 1:
            reduced["step_scale"] = plan.step_scale
        reduced |= {name: number for name, number in used["dropped"].items() if number}
    binding = ["size"] if reduced else []
    if plan.seconds is not None:
        if epochs < stream.epochs and used["stopped_by_clock"]:
            reduced["epochs"] = stream.epochs - epochs
        if plan.part_scale < 1:
            reduced["part_scale"] = plan.part_scale
        if plan.change_threshold > stream.change_threshold:
            reduced["change_threshold"] = [stream.change_threshold, plan.change_threshold]
        if used["stopped_by_clock"] or plan.part_scale < 1:
            binding.append("time")
    known = {"time": plan.predicted_seconds, "size": plan.predicted_bytes}
    return {
        "predicted": {name: value for name, value in known.items() if value is not None},
        "binding": binding,
        "reduced": reduced,
        "usage": {
            "epochs": epochs,
            "planned_epochs": plan.epochs,
            "rd_lambda": used["rd_lambda"],
            "step_scale": plan.step_scale,
            "change_threshold": plan.change_threshold,
            "estimated_bytes": used["estimate"],
            "untrimmed_bytes": used["untrimmed"],
            "seconds_before": used["before"],
            "seconds_optimise": used["optimise"],
            "parts": used["parts"],
            "part_scale": plan.part_scale,
        },
    }
