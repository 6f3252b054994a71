"""What one frame is to spend: a pure function of the budget, the recipe and what earlier frames cost.

Order in which quality is given up. Size: weight of the rate, then coarser steps, then symbols and gates of the finished
packet (:mod:`gsstream.engine.budget.trim`). Time: passes, then what counts as changed;
passes of motion and growth where no residual is learned.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

from gsstream.method.budget import FrameBudget
from gsstream.recipe.budget import Budget
from gsstream.recipe.model import Stream

#: Number of earlier frames that a plan is made from.
WINDOW = 5
#: Share of a time budget that is planned; the rest is a reserve for delays that cannot be predicted.
TIME_MARGIN = 0.93
#: Below this share of a size budget the weight falls; above this multiple it rises. In between, the packet is trimmed:
#: trimming saves 43 % of the bytes and costs less quality than a larger weight does.
SIZE_TARGET, MAX_TRIMMED = 0.94, 2.0
#: Largest share of the time that is kept for the phases after the passes, while no frame has shown what they cost.
UNKNOWN_RESERVE = 0.2
#: Smallest part_scale of a plan: motion and growth keep this share of their iterations in frames without a residual.
MIN_PART_SCALE = 0.05
#: Share of a pass's time that does not depend on the number of candidates.
FIXED_SHARE = 0.3
#: Most passes over the cameras that a budget of time spends on one frame, where the recipe has fewer.
MOST_EPOCHS = 30
#: When fewer passes than this fit, it is better to have fewer candidates and more passes.
MIN_EPOCHS = 4
#: Weights of the rate that the controller may use; recipes ship 3e-4, which halves the bytes.
MIN_WEIGHT, MAX_WEIGHT = 3e-5, 3e-2
#: Steps get at most this much coarser.
MAX_STEP_SCALE = 4.0
#: Largest factor on the recipe's threshold of change; and the threshold that the factor is applied to where the recipe
#: has none.
MAX_THRESHOLD, FIRST_THRESHOLD = 4.0, 3.0


@dataclass(frozen=True, slots=True)
class Past:
    """The cost of one earlier frame that was optimised."""

    frame: int
    epochs: float  # passes made
    candidates: int  # Gaussians that took part
    #: before, optimise, after: seconds of the frame until its passes begin, of the passes, and of what follows them.
    before: float
    optimise: float
    after: float
    #: weight, step_scale, threshold: settings that the frame was made with; the weight is that of the last half of the
    #: passes.
    weight: float
    step_scale: float
    threshold: float
    estimate: float  # bytes expected after the last pass; 0: not estimated
    untrimmed: int  # bytes before trimming
    size: int  # bytes
    parts: float = 0.0  # seconds of motion and growth
    part_scale: float = 1.0  # share of their passes that they made


def read_past_frame(metrics: Mapping[str, Any]) -> Past | None:
    """Return a line of ``metrics.jsonl`` as the planner sees it; None for frames that were not optimised."""
    usage = metrics.get("budget", {}).get("usage")
    if usage is None:
        return None
    return Past(
        frame=int(metrics["frame"]),
        epochs=float(usage["epochs"]),
        candidates=int(metrics.get("candidate_gaussians", metrics["num_gaussians"])),
        before=float(usage["seconds_before"]),
        optimise=float(usage["seconds_optimise"]),
        after=float(usage["seconds"]) - float(usage["seconds_before"]) - float(usage["seconds_optimise"]),
        weight=float(usage["rd_lambda"]),
        step_scale=float(usage["step_scale"]),
        threshold=float(usage["change_threshold"]),
        estimate=float(usage["estimated_bytes"]),
        untrimmed=int(usage["untrimmed_bytes"]),
        size=sum(metrics["bytes"].values()),
        parts=float(usage["parts"]),
        part_scale=float(usage["part_scale"]),
    )


def unlimited(stream: Stream) -> FrameBudget:
    """Return the budget of a frame without limits: the numbers of the recipe."""
    return FrameBudget(stream.epochs, stream.change_threshold, stream.rd_lambda)


def plan(budget: Budget, stream: Stream, history: Sequence[Past]) -> FrameBudget:
    """Return what the next frame is to spend; when it starts is not known here."""
    recent = history[-WINDOW:]
    each, (before, after) = seconds_per_epoch(recent), _other_seconds(recent)
    epochs = _epochs(budget, stream, each, before + after)
    size = budget.size
    held = size is not None
    seconds = None if budget.time is None else TIME_MARGIN * budget.time
    known = [p.untrimmed for p in recent[-3:]]
    expected = min(median(known), size or math.inf) if known else None
    return FrameBudget(
        epochs=epochs,
        change_threshold=_threshold(budget, stream, recent),
        rd_lambda=_weight(budget, stream, recent) if held else stream.rd_lambda,
        max_epochs=max(stream.epochs, MOST_EPOCHS),
        step_scale=_step_scale(recent) if held else 1.0,
        part_scale=_part_scale(budget, [p for p in recent if p.epochs == 0]),
        max_bytes=size,
        correction=_correction(recent),
        seconds=seconds,
        after=after if recent else None,
        each=each,
        candidates=recent[-1].candidates if recent else 0,
        predicted_seconds=None if each is None else before + each * epochs + after,
        predicted_bytes=expected,
    )


def seconds_per_epoch(history: Sequence[Past]) -> float | None:
    """Return the median of what a pass took in the last three frames; None while nothing is known."""
    known = [p.optimise / p.epochs for p in history[-3:] if p.epochs > 0]
    return median(known) if known else None


def epochs_in(seconds: float, each: float, most: int) -> int:
    """Return how many passes fit into a time, at least 1."""
    if each <= 0:
        return most
    return max(1, min(most, math.floor(min(seconds / each, most) + 1e-9)))


def scale_epoch_seconds(each: float, then: int, now: int) -> float:
    """Return the seconds of a pass with another number of candidates; a part of it does not scale."""
    return each * (FIXED_SHARE + (1 - FIXED_SHARE) * now / then) if then > 0 else each


def _epochs(budget: Budget, stream: Stream, each: float | None, around: float) -> int:
    """Passes that fit beside ``around`` seconds of everything else."""
    if budget.time is None:
        return stream.epochs
    most = max(stream.epochs, MOST_EPOCHS)
    return most if each is None else epochs_in(TIME_MARGIN * budget.time - around, each, most)


def _other_seconds(recent: Sequence[Past]) -> tuple[float, float]:
    """Seconds before and after the passes."""
    if not recent:
        return 0.0, 0.0
    # The phases after the passes cannot be cut short, so the slowest of the last frames counts, unless it was an
    # outlier.
    after = [p.after for p in recent]
    return median(p.before for p in recent), min(max(after), 2 * median(after))


def _part_scale(budget: Budget, recent: Sequence[Past]) -> float:
    """Share of the passes of motion and growth that fits into the time, by frames in which no residual was learned."""
    if budget.time is None or not recent:
        return 1.0
    whole = median(p.parts / p.part_scale for p in recent[-3:])
    others = median(p.before + p.after - p.parts for p in recent[-3:])
    fits = (TIME_MARGIN * budget.time - others) / whole if whole > 0 else 1.0
    return min(max(fits, MIN_PART_SCALE), 1.0)


def _threshold(budget: Budget, stream: Stream, recent: Sequence[Past]) -> float:
    """Return the next frame's threshold of change.

    It rises after two frames in which too few passes fitted into the time, and else falls back towards the recipe's.
    """
    usual = stream.change_threshold
    if budget.time is None or not recent or recent[-1].epochs == 0:
        return usual
    last, most = recent[-1], MAX_THRESHOLD * (usual or FIRST_THRESHOLD)
    few = min(MIN_EPOCHS, stream.epochs)
    if len(recent) > 1 and max(last.epochs, recent[-2].epochs) < few:
        return min(1.5 * last.threshold if last.threshold else FIRST_THRESHOLD, most)
    if last.epochs >= 2 * MIN_EPOCHS and last.threshold > usual:
        lower = last.threshold / 1.25
        return lower if lower > max(usual, 0.7 * FIRST_THRESHOLD) else usual
    return last.threshold


def _weight(budget: Budget, stream: Stream, recent: Sequence[Past]) -> float:
    """The recipe's, or less where the last frame left bytes over.

    Never more: a residual that is taxed from the first pass on does not grow to what it should be. To let it grow and
    to trim the packet is better by far at equal bytes.
    """
    start = stream.rd_lambda or MIN_WEIGHT
    if recent and budget.size is not None:
        missed = recent[-1].untrimmed / (SIZE_TARGET * budget.size)
        start = min(start, recent[-1].weight * min(max(missed**1.5, 0.5), 2.0))
    return min(max(start, MIN_WEIGHT), MAX_WEIGHT)


def _step_scale(recent: Sequence[Past]) -> float:
    """Coarser steps while the weight of the rate has nothing left to give."""
    if not recent:
        return 1.0
    last = recent[-1]
    if last.weight >= 0.5 * MAX_WEIGHT and last.untrimmed > last.size:
        return min(2**0.5 * last.step_scale, MAX_STEP_SCALE)
    return max(1.0, last.step_scale / 2**0.5) if last.weight < 0.1 * MAX_WEIGHT else last.step_scale


def _correction(recent: Sequence[Past]) -> float:
    """Real over estimated bytes of the last frame that had both."""
    known = [p.untrimmed / p.estimate for p in recent if p.estimate > 0]
    return min(max(known[-1], 0.8), 3.0) if known else 1.1
