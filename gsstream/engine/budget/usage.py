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
    given_up: dict[str, Any] = {}
    if plan.max_bytes is not None:
        if used["rd_lambda"] > 1.05 * stream.rd_lambda:
            given_up["rd_lambda"] = [stream.rd_lambda, used["rd_lambda"]]
        if plan.step_scale > 1:
            given_up["step_scale"] = plan.step_scale
        given_up |= {name: number for name, number in used["dropped"].items() if number}
    bound = ["size"] if given_up else []
    if plan.seconds is not None:
        if epochs < stream.epochs and used["stopped_by_clock"]:
            given_up["epochs"] = stream.epochs - epochs
        if plan.part_scale < 1:
            given_up["part_scale"] = plan.part_scale
            bound.append("time")
        if plan.change_threshold > stream.change_threshold:
            given_up["change_threshold"] = [stream.change_threshold, plan.change_threshold]
        if used["stopped_by_clock"]:
            bound.append("time")
    known = {"time": plan.predicted_seconds, "size": plan.predicted_bytes}
    return {
        "predicted": {name: value for name, value in known.items() if value is not None},
        "bound": bound,
        "given_up": given_up,
        "spent": {
            "epochs": epochs, "planned_epochs": plan.epochs, "rd_lambda": used["rd_lambda"],
            "step_scale": plan.step_scale, "change_threshold": plan.change_threshold, "estimate": used["estimate"],
            "untrimmed": used["untrimmed"], "before": used["before"], "optimise": used["optimise"],
            "parts": used["parts"], "part_scale": plan.part_scale,
        },
    }  # fmt: skip
