"""What one frame spent of its budget, in the words of ``metrics.jsonl``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gsstream.engine.budget.epoch_scheduler import Allowance, EpochScheduler
from gsstream.engine.budget.schedule import Schedule
from gsstream.engine.budget.trim import TrimmedDelta
from gsstream.recipe.model import Stream


def usage(pace: Schedule, fitted: TrimmedDelta) -> dict[str, Any]:
    """Return what the optimisation of a frame used, and what fitting its packet gave up: raw numbers for the log."""
    assert isinstance(pace, EpochScheduler)
    return {
        "rd_lambda": pace.mean_rate_weight, "estimate": pace.estimate, "stopped_by_clock": pace.stopped_by_clock,
        "untrimmed": fitted.untrimmed, "before": pace.before, "optimise": pace.optimise,
        "dropped": {"symbols": fitted.symbols, "gates": fitted.gates, "added": fitted.added},
    }  # fmt: skip


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
            "epochs": epochs, "planned_epochs": plan.epochs, "rd_lambda": used["rd_lambda"],
            "step_scale": plan.step_scale, "change_threshold": plan.change_threshold,
            "estimated_bytes": used["estimate"], "untrimmed_bytes": used["untrimmed"],
            "seconds_before": used["before"], "seconds_optimise": used["optimise"],
            "parts": used["parts"], "part_scale": plan.part_scale,
        },
    }  # fmt: skip
