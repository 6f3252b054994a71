"""The controller of a run: a plan before every frame, and after it what it cost, what bound and what was given up.

Its memory is the run's ``metrics.jsonl`` alone, so a resumed run plans as the first would have.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from gsstream.core.log import FrameLog
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.budget.epoch_scheduler import Allowance, EpochScheduler
from gsstream.engine.budget.plan import WINDOW, Past, plan, read_past_frame
from gsstream.engine.budget.schedule import Schedule
from gsstream.engine.budget.trim import TrimmedDelta
from gsstream.method.base import Step
from gsstream.method.tools import FrameBudget
from gsstream.metrics import peak_memory_mb
from gsstream.recipe.budget import Budget
from gsstream.recipe.model import Stream


class Controller:
    """Plans frames of one run and writes down what became of the plans; does nothing where the budget is empty."""

    def __init__(self, budget: Budget, stream: Stream) -> None:
        self.budget, self._stream = budget, stream
        self._history: tuple[Past, ...] = ()
        self._key: tuple[float, float] | None = None

    def remember(self, lines: Iterable[Mapping[str, Any]]) -> None:
        """Go on after these lines of ``metrics.jsonl``; without a budget there is nothing to remember."""
        for line in lines if self.budget.limits_anything else ():
            self._note(line)

    def allow(self, log: FrameLog) -> Allowance | None:
        """Return what the frame of this log may spend; None without a limit on frames."""
        if not self.budget.limits_frames:
            return None
        return Allowance.start(plan(self.budget, self._stream, self._history), log.elapsed())

    def describe(self, budget: Allowance, step: Step[Any], views: int, log: FrameLog) -> None:
        """Log what a frame spent of its budget, where its method made iterations or logged its own use (``budget``).

        Without it, a method is described by its phases and the size of its packet.
        """
        numbers = log.numbers
        if not numbers.get("iterations") and "budget" not in numbers:
            return
        used = numbers.get("budget") or {
            "rd_lambda": budget.plan.rd_lambda,
            "estimate": 0.0,
            "stopped_by_clock": False,
            "untrimmed": len(step.packet.data),
            "dropped": {},
            "before": log.seconds("change", "motion", "confidence"),
            "optimise": log.seconds("optimise"),
        }
        used = {**used, "parts": log.seconds("motion", "growth")}
        log.set(budget=spent(budget, used, self._stream, numbers.get("iterations", 0) / views))

    def key_refusal(self, num_gaussians: int, allowance: Allowance | None) -> str | None:
        """Say why a key packet that is due must wait, by what the last one cost; None: it may be tried."""
        if allowance is None or self._key is None:
            return None
        size, seconds = (value * num_gaussians for value in self._key)
        if self.budget.size is not None and 0.9 * size > self.budget.size:
            return f"about {size:.0f} bytes where {self.budget.size} are allowed"
        if self.budget.time is not None and allowance.clock() - allowance.started + seconds > self.budget.time:
            return f"about {seconds:.2f} s where {self.budget.time:g} s are allowed for the frame"
        return None

    def settle(self, frame: int, status: str, log: FrameLog) -> None:
        """Complete the entry ``budget`` of a finished frame, and remember what the frame cost."""
        numbers = log.numbers
        entry, seconds = dict(numbers.get("budget", {})), log.elapsed()
        size, first = sum(numbers["bytes"].values()), frame == 0
        actual = {"time": seconds, "size": size, "memory": 1e6 * peak_memory_mb()}
        limits = {name: getattr(self.budget, name) for name in actual if getattr(self.budget, name) is not None}
        if first:  # what everything starts from is no frame of a budget (docs/howto/budget.md)
            limits = {name: limit for name, limit in limits.items() if name == "memory"}
        entry["limits"] = limits
        entry["actual"] = {name: actual[name] for name in limits}
        entry["violated"] = [name for name, limit in limits.items() if actual[name] > limit]
        if "usage" in entry:
            entry["usage"] = {**entry["usage"], "seconds": seconds}
            entry["binding"] = [name for name in entry.get("binding", []) if name in limits]
        log.set(budget=entry)
        # As it will be read back: a resumed run must plan with the same numbers.
        self._note(json.loads(json.dumps({"frame": frame, "status": status, **log.entry()})))

    def _note(self, metrics: Mapping[str, Any]) -> None:
        if metrics["status"] == "key" and metrics["num_gaussians"]:
            size = sum(metrics["bytes"].values())
            seconds = metrics["seconds"].get("key", metrics["seconds"].get("code", 0.0))
            self._key = size / metrics["num_gaussians"], seconds / metrics["num_gaussians"]
        past = read_past_frame(metrics)
        if past is not None:
            self._history = (*self._history, past)[-WINDOW:]


def apply_plan(assembly: Assembly, budget: FrameBudget) -> Assembly:
    """Return the parts with the recipe of one frame: the plan's epochs, threshold and weight."""
    assert isinstance(budget, Allowance)
    frame_plan = budget.plan
    changes = {
        "epochs": frame_plan.epochs,
        "change_threshold": frame_plan.change_threshold,
        "rd_lambda": frame_plan.rd_lambda,
    }
    recipe = assembly.recipe
    return replace(assembly, recipe=recipe.model_copy(update={"stream": recipe.stream.model_copy(update=changes)}))


def usage(pace: Schedule, fitted: TrimmedDelta) -> dict[str, Any]:
    """Return what the optimisation of a frame used, and what fitting its packet gave up: raw numbers for the log."""
    assert isinstance(pace, EpochScheduler)
    return {
        "rd_lambda": pace.mean_rate_weight,
        "estimate": pace.estimate,
        "stopped_by_clock": pace.stopped_by_clock,
        "untrimmed": fitted.untrimmed,
        "before": pace.before,
        "optimise": pace.optimise,
        "dropped": {"symbols": fitted.symbols, "gates": fitted.gates, "added": fitted.added},
    }


def spent(budget: Allowance, used: Mapping[str, Any], stream: Stream, epochs: float) -> dict[str, Any]:
    """Return the entry ``budget`` of a frame, before its limits and the cost of the whole frame are added.

    ``used`` is that of :func:`usage`; ``stream`` holds the recipe's own settings, from which the plan departed.
    """
    plan = budget.plan
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
