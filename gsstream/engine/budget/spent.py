"""What one optimised frame spent of its allowance, in the words of ``metrics.jsonl``."""

from __future__ import annotations

from typing import Any

from gsstream.engine.budget.pace import Allowance, EpochScheduler
from gsstream.engine.budget.trim import Fitted
from gsstream.recipe.model import Stream


def spent(
    allowance: Allowance, pace: EpochScheduler, fitted: Fitted, stream: Stream, epochs: float
) -> dict[str, Any]:
    """Return the entry ``budget`` of a frame, before its limits and the cost of the whole frame are added.

    Arguments:
        allowance: what the frame was allowed.
        pace: what its passes were held to.
        fitted: its packet, and what fitting it gave up.
        stream: the recipe's own settings, from which the plan departed.
        epochs: passes made.
    """
    plan = allowance.plan
    given_up: dict[str, Any] = {}
    if plan.max_bytes is not None:
        if pace.typical_weight > 1.05 * stream.rate_weight:
            given_up["rate_weight"] = [stream.rate_weight, pace.typical_weight]
        if plan.step_scale > 1:
            given_up["step_scale"] = plan.step_scale
        dropped = {"symbols": fitted.symbols, "gates": fitted.gates, "births": fitted.births}
        given_up |= {name: number for name, number in dropped.items() if number}
    bound = ["size"] if given_up else []
    if plan.seconds is not None:
        if epochs < stream.epochs and pace.stopped_by_clock:
            given_up["epochs"] = stream.epochs - epochs
        if plan.change_threshold > stream.change_threshold:
            given_up["change_threshold"] = [stream.change_threshold, plan.change_threshold]
        if pace.stopped_by_clock:
            bound.append("time")
    known = {"time": plan.predicted_seconds, "size": plan.predicted_bytes}
    return {
        "predicted": {name: value for name, value in known.items() if value is not None},
        "bound": bound,
        "given_up": given_up,
        "spent": {
            "epochs": epochs, "planned_epochs": plan.epochs, "rate_weight": pace.typical_weight,
            "step_scale": plan.step_scale, "change_threshold": plan.change_threshold, "estimate": pace.estimate,
            "untrimmed": fitted.untrimmed, "before": pace.before, "optimise": pace.optimise,
        },
    }  # fmt: skip
