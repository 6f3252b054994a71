"""How the optimiser keeps to a budget: how many passes the clock still allows, and how strongly bits are weighed."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from statistics import mean
from typing import Any

import torch

from gsstream.engine.budget.plan import (
    MAX_TRIMMED,
    MAX_WEIGHT,
    MIN_WEIGHT,
    SIZE_TARGET,
    UNKNOWN_RESERVE,
    epochs_in,
    scale_epoch_seconds,
)
from gsstream.engine.budget.trim import TrimmedDelta
from gsstream.method.budget import FrameBudget

#: Share of the passes after which the size is first estimated: before that, residuals are still growing.
SIZE_ESTIMATE_START = 0.25


class EpochScheduler:
    """Passes and rate weight of one frame, corrected by what its own passes take where the budget limits them.

    ``epochs`` (passes that are planned), ``done`` (passes that are made) and ``rd_lambda`` (loss per bit) are read in
    every pass. It measures by itself: a piece of a pass lasts until the next piece is asked for.

    Arguments:
        budget: budget of the frame.
        views: training cameras.
        candidates: how many Gaussians take part.
        epoch_scale: share of the passes that the frame is worth, and of the time that they have.
    """

    def __init__(self, budget: FrameBudget, views: int, candidates: int, epoch_scale: float = 1.0) -> None:
        self.budget, self._views, self._epoch_scale = budget, views, epoch_scale
        #: Whether there is a limit on time; on bytes.
        self.timed, self.sized = budget.seconds is not None, budget.max_bytes is not None
        self.epochs, self.done, self.rd_lambda = max(1, round(budget.epochs * epoch_scale)), 0, budget.rd_lambda
        #: Whether the clock allows fewer passes than there could be; whether it has ended one in the middle.
        self.stopped_by_clock = self.is_cut = False
        #: When the optimisation began and when its last piece has ended, by the budget's clock.
        self._began = self._read = budget.clock()
        self._seconds_of_views, self._weights, self._estimate = list[float](), list[float](), 0.0
        if budget.seconds is not None:
            self._plan_by_clock(candidates, budget.seconds)

    def _plan_by_clock(self, candidates: int, seconds: float) -> None:
        """With a limit on time the number of passes is a prediction, and the clock may allow more."""
        budget, self._seconds = self.budget, seconds
        self._most = max(self.epochs, round(self._epoch_scale * budget.max_epochs))
        # The phases before the passes render every view once, forwards and backwards. Without earlier frames to go by,
        # their time is the estimate of a pass.
        each = budget.each
        self._each = self.before if each is None else scale_epoch_seconds(each, budget.candidates, candidates)
        self.epochs = epochs_in(self._left(), self._each, self._most)

    @property
    def before(self) -> float:
        """Seconds of the frame until its optimisation began."""
        return self._began - self.budget.started

    @property
    def optimise(self) -> float:
        """Seconds of the passes."""
        return self._read - self._began

    @property
    def goes_on(self) -> bool:
        """Whether another pass is to be made."""
        return self.done < self.epochs and not self.is_cut

    def next_pass(self, order: Sequence[int]) -> Iterator[Sequence[int]]:
        """Yield the views of a pass in this order: one by one, until the clock ends it, under a limit on time."""
        some = 1 if self.timed else len(order)
        for begin in range(0, len(order), some):
            yield order[begin : begin + some]
            before, self._read = self._read, self.budget.clock()
            if self.timed and self._is_late(self._read - before):
                self.is_cut = self.stopped_by_clock = True
                return
        self.done += 1
        if self.timed:
            self._plan_rest()

    def weigh_bytes(self, estimate: float) -> None:
        """Move the weight of the rate by the bytes that a pass would have sent, before their correction.

        Without a limit on bytes the weight stays.
        """
        if (limit := self.budget.max_bytes) is None:
            return
        self._estimate = estimate
        self._weights.append(self.rd_lambda)
        if self.done < SIZE_ESTIMATE_START * self.epochs:
            return
        expected = self._estimate * self.budget.correction
        # Between the two bounds the weight stays, and trimming makes the packet fit.
        wanted = min(max(expected, SIZE_TARGET * limit), MAX_TRIMMED * limit)
        self.rd_lambda = next_rate_weight(self.rd_lambda, expected, wanted)

    @property
    def mean_rate_weight(self) -> float:
        """Geometric mean of the weight over the last half of the passes, which decides the bytes of the frame."""
        last = self._weights[len(self._weights) // 2 :] or [self.rd_lambda]
        return math.exp(sum(map(math.log, last)) / len(last)) if min(last) > 0 else self.rd_lambda

    def usage(self, fitted: TrimmedDelta) -> dict[str, Any]:
        """Return what the optimisation used, and what fitting its packet gave up: raw numbers for the log."""
        return {
            "rd_lambda": self.mean_rate_weight,
            "estimate": self._estimate,
            "stopped_by_clock": self.stopped_by_clock,
            "untrimmed": fitted.untrimmed,
            "before": self.before,
            "optimise": self.optimise,
            "dropped": fitted.given_up(),
        }

    def _left(self) -> float:
        """Seconds for passes since the clock was read last.

        The time of what follows the passes is not known before a frame has shown it: until then it is taken to be that
        of one pass.
        """
        seconds, after = self._seconds, self.budget.after
        kept = min(self._each, UNKNOWN_RESERVE * seconds) if after is None else after
        # A run that is behind gives its frames less time, to catch up: the time that such a frame saves must not be
        # spent on more passes.
        given_up = (1 - self._epoch_scale) * (seconds - kept - self.before)
        return self.budget.started + seconds - kept - self._read - max(0.0, given_up)

    def _is_late(self, took: float) -> bool:
        """Say, after a view that took so many seconds, whether the time for another one is gone."""
        self._seconds_of_views.append(took)
        usual = self._last_pass()
        if usual and self.budget.each is None and len(self._seconds_of_views) < self._views:
            self._each = self._views * mean(usual)
            made = len(self._seconds_of_views) / self._views
            self.epochs = epochs_in(self._left() + made * self._each, self._each, self._most)
        return max(usual[-3:], default=0.0) > self._left()

    def _plan_rest(self) -> None:
        """Plan the passes that are left by what the last one took."""
        self._each = self._views * mean(self._last_pass() or self._seconds_of_views)
        left = self._left()
        more = 0 if left < 0.25 * self._each else epochs_in(left, self._each, max(1, self._most - self.done))
        self.epochs = min(self.done + more, self._most)
        self.stopped_by_clock = self.epochs == self.done < self._most

    def _last_pass(self) -> list[float]:
        """Seconds of the views of the last pass, without the frame's first, which pays for what is made once."""
        return self._seconds_of_views[1:][-self._views :]


def next_rate_weight(weight: float, expected: float, wanted: float) -> float:
    """Return the weight of the rate after a pass that would send more or fewer bytes than are wanted.

    Bytes fall with about the square root of the weight, so the first power leads half of the way to the goal; a factor
    of three a pass is the most that residuals can follow. Symbols that a high weight has removed come back slowly, so
    the weight falls half as fast as it rises.
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
