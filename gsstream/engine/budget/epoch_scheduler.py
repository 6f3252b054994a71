"""How the optimiser keeps to a plan: how many passes the clock still allows, and how strongly bits are weighed."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from statistics import mean

import torch

from gsstream.core.frame import Frame
from gsstream.engine.budget.plan import (
    MAX_TRIMMED,
    MAX_WEIGHT,
    MIN_WEIGHT,
    SIZE_TARGET,
    UNKNOWN_RESERVE,
    FramePlan,
    epochs_in,
    scale_epoch_seconds,
)
from gsstream.engine.budget.schedule import Schedule
from gsstream.method.tools import FrameBudget
from gsstream.recipe.model import Stream

#: Share of the passes after which the size is first estimated: before that, residuals are still growing.
SIZE_ESTIMATE_START = 0.25


@dataclass(frozen=True)
class Allowance:
    """A plan and the clock it runs against; ``started`` is the start of the frame by that clock."""

    plan: FramePlan
    started: float
    clock: Callable[[], float]

    @staticmethod
    def start(plan: FramePlan, elapsed: float = 0.0) -> Allowance:
        """Return an allowance of a frame that began ``elapsed`` seconds ago."""
        return Allowance(plan, time.perf_counter() - elapsed, time.perf_counter)

    @property
    def max_bytes(self) -> int | None:
        return self.plan.max_bytes

    @property
    def epochs(self) -> int:
        return self.plan.epochs

    @property
    def step_scale(self) -> float:
        return self.plan.step_scale

    @property
    def part_scale(self) -> float:
        return self.plan.part_scale

    def seconds_left(self) -> float | None:
        return None if self.plan.seconds is None else self.started + self.plan.seconds - self.clock()


class EpochScheduler(Schedule):
    """Passes and weight of one frame under a budget, corrected by what its own passes take.

    ``epoch_scale``: share of the passes that the frame is worth, and of the time that they have.
    """

    def __init__(
        self, allowance: Allowance, epochs: int, rd_lambda: float, views: int, epoch_scale: float = 1.0
    ) -> None:
        super().__init__(epochs, rd_lambda)
        plan = allowance.plan
        self._timed = allowance if plan.seconds is not None else None
        self.chunk = 1 if self._timed else None
        # With a time budget the number of passes in the plan is a prediction, and the clock may allow more.
        self._most = max(epochs, round(epoch_scale * plan.max_epochs)) if self._timed else epochs
        self._epoch_scale = epoch_scale
        self.estimate = 0.0
        self._weights: list[float] = []
        self.stopped_by_clock = False
        self._allowance, self._views = allowance, views
        #: Seconds until the optimisation began, and of it, by the budget's clock.
        self.before, self.optimise = allowance.clock() - allowance.started, 0.0
        #: Seconds a pass is expected to take.
        self._each = 0.0
        self._iteration_began = 0.0
        self._iterations: list[float] = []

    def start(self, candidates: int) -> None:
        """Note that the first pass begins, with so many Gaussians."""
        if self._timed is None:
            return
        now, plan = self._timed.clock(), self._timed.plan
        self._iteration_began = now
        # The phases before the passes render every view once, forwards and backwards. Without earlier frames to go by,
        # their time is the estimate of a pass.
        before = now - self._timed.started
        self._each = before if plan.each is None else scale_epoch_seconds(plan.each, plan.candidates, candidates)
        self.epochs = epochs_in(self._left(now), self._each, self._most)

    def _left(self, now: float) -> float:
        """Seconds for passes from now on.

        What follows them is not known before a frame has shown it: until then it is taken for one more pass.
        """
        assert self._timed is not None
        assert self._timed.plan.seconds is not None
        seconds, after = self._timed.plan.seconds, self._timed.plan.after
        kept = min(self._each, UNKNOWN_RESERVE * seconds) if after is None else after
        # A run that is behind hurries to catch up: what the passes of a hurried frame leave of its time is not theirs.
        given_up = (1 - self._epoch_scale) * (seconds - kept - self.before)
        return self._timed.started + seconds - kept - now - max(0.0, given_up)

    def finish(self) -> None:
        """Note that the optimisation has ended."""
        self.optimise = self._allowance.clock() - self._allowance.started - self.before

    @property
    def mean_rate_weight(self) -> float:
        """Geometric mean over the last half of the passes: what the bytes of the frame answer to."""
        last = self._weights[len(self._weights) // 2 :] or [self.rd_lambda]
        return math.exp(sum(map(math.log, last)) / len(last)) if min(last) > 0 else self.rd_lambda

    def is_over(self) -> bool:
        """Say, after every iteration, whether the time for another one is gone."""
        if self._timed is None:
            return False
        now = self._timed.clock()
        self._iterations.append(now - self._iteration_began)
        self._iteration_began = now
        usual = self._last_epoch_seconds()
        if usual and self._timed.plan.each is None and len(self._iterations) < self._views:
            self._each = self._views * mean(usual)
            made = len(self._iterations) / self._views
            self.epochs = epochs_in(self._left(now) + made * self._each, self._each, self._most)
        self.stopped_by_clock = max(usual[-3:], default=0.0) > self._left(now)
        return self.stopped_by_clock

    def end_epoch(self, done: int) -> None:
        """Plan the passes that are left by what the last one took. ``done``: passes made."""
        if self._timed is None:
            return
        now = self._timed.clock()
        self._each = self._views * mean(self._last_epoch_seconds() or self._iterations)
        left = self._left(now)
        more = 0 if left < 0.25 * self._each else epochs_in(left, self._each, max(1, self._most - done))
        self.epochs = min(done + more, self._most)
        self.stopped_by_clock = self.epochs == done < self._most

    def _last_epoch_seconds(self) -> list[float]:
        """Seconds of the iterations of the last pass, without the frame's first, which pays for what is made once."""
        return self._iterations[1:][-self._views :]

    def weigh_bytes(self, done: int, estimate: Callable[[], float]) -> None:
        """Move the weight of the rate by what a pass would have sent, where a size is to be met.

        ``estimate``: bytes, before the correction.
        """
        plan = self._allowance.plan
        if plan.max_bytes is None:
            return
        self.estimate = estimate()
        self._weights.append(self.rd_lambda)
        if done < SIZE_ESTIMATE_START * self.epochs:
            return
        expected = self.estimate * plan.correction
        # Between the two bounds the weight stays, and trimming makes the packet fit.
        wanted = min(max(expected, SIZE_TARGET * plan.max_bytes), MAX_TRIMMED * plan.max_bytes)
        self.rd_lambda = next_rate_weight(self.rd_lambda, expected, wanted)


def scheduled(stream: Stream, frame: Frame, budget: FrameBudget | None) -> Schedule:
    """Return the schedule of a frame: as the recipe, or the plan of its budget, says."""
    epochs = max(1, round(stream.epochs * frame.epoch_scale))
    if budget is None:
        return Schedule(epochs, stream.rd_lambda)
    assert isinstance(budget, Allowance)
    return EpochScheduler(
        allowance=budget,
        epochs=epochs,
        rd_lambda=stream.rd_lambda,
        views=len(frame.cameras),
        epoch_scale=frame.epoch_scale,
    )


def next_rate_weight(weight: float, expected: float, wanted: float) -> float:
    """Return the weight of the rate after a pass that would send more or fewer bytes than are wanted.

    Bytes fall with about the square root of the weight, so the first power leads half of the way to
    the goal; a factor of three a pass is the most that residuals can follow. What was taken back comes slowly
    again, so the way down is half as fast.
    """
    factor = min(max(expected / wanted, 1 / 9), 3.0)
    factor = factor if factor > 1 else factor**0.5
    return min(max(weight * factor, MIN_WEIGHT), MAX_WEIGHT)


def estimated_bytes(symbols: torch.Tensor) -> float:
    """Return the bytes of a table of symbols [A, L]: the entropy of each channel's histogram, and its model."""
    rows, channels = symbols.shape
    if rows == 0 or channels == 0:
        return 0.0
    low = int(symbols.min())
    width = int(symbols.max()) - low + 1
    keys = (symbols - low).long() + width * torch.arange(channels, device=symbols.device)
    counts = torch.bincount(keys.reshape(-1), minlength=width * channels).double()
    used = counts[counts > 0]
    return float((used * (rows / used).log2()).sum()) / 8 + 0.75 * len(used) + 8 * channels
