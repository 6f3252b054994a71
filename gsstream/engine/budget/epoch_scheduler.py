"""How the optimiser keeps to a budget: how many passes the clock still allows, and how strongly bits are weighed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
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
        budget: of the frame.
        views: training cameras.
        candidates: how many Gaussians take part.
        epoch_scale: share of the passes that the frame is worth, and of the time that they have.
    """

    def __init__(self, budget: FrameBudget, views: int, candidates: int, epoch_scale: float = 1.0) -> None:
        self.budget, self._views, self._epoch_scale = budget, views, epoch_scale
        self.epochs, self.done = max(1, round(budget.epochs * epoch_scale)), 0
        self.rd_lambda, self.estimate, self._weights = budget.rd_lambda, 0.0, list[float]()
        #: Whether the clock allows fewer passes than there could be; whether it has ended one in the middle.
        self.stopped_by_clock = self.is_cut = False
        self._piece_began, self._pieces = budget.clock(), list[float]()
        #: Seconds until the optimisation began, and of it, by the budget's clock.
        self.before, self.optimise = self._piece_began - budget.started, 0.0
        if budget.seconds is None:
            return
        self._seconds = budget.seconds
        # With a limit on time the number of passes is a prediction, and the clock may allow more.
        self._most = max(self.epochs, round(epoch_scale * budget.max_epochs))
        # The phases before the passes render every view once, forwards and backwards. Without earlier frames to go by,
        # their time is the estimate of a pass.
        each = budget.each
        self._each = self.before if each is None else scale_epoch_seconds(each, budget.candidates, candidates)
        self.epochs = epochs_in(self._left(), self._each, self._most)

    @property
    def goes_on(self) -> bool:
        """Whether another pass is to be made."""
        return self.done < self.epochs and not self.is_cut

    def next_pass(self, order: Sequence[int]) -> Iterator[Sequence[int]]:
        """Yield the views of a pass in this order: one by one, until the clock ends it, under a limit on time."""
        timed = self.budget.seconds is not None
        some = 1 if timed else len(order)
        for begin in range(0, len(order), some):
            yield order[begin : begin + some]
            self._measure()
            if timed and self._is_late():
                self.is_cut = self.stopped_by_clock = True
                return
        self.done += 1
        if timed:
            self._plan_rest()

    def weigh_bytes(self, estimate: Callable[[], float]) -> None:
        """Move the weight of the rate by what a pass would have sent, where a size is to be met.

        ``estimate``: bytes, before the correction; it is called only where a size is to be met.
        """
        limit = self.budget.max_bytes
        if limit is None:
            return
        self.estimate = estimate()
        self._weights.append(self.rd_lambda)
        if self.done < SIZE_ESTIMATE_START * self.epochs:
            return
        expected = self.estimate * self.budget.correction
        # Between the two bounds the weight stays, and trimming makes the packet fit.
        wanted = min(max(expected, SIZE_TARGET * limit), MAX_TRIMMED * limit)
        self.rd_lambda = next_rate_weight(self.rd_lambda, expected, wanted)

    @property
    def mean_rate_weight(self) -> float:
        """Geometric mean over the last half of the passes: what the bytes of the frame answer to."""
        last = self._weights[len(self._weights) // 2 :] or [self.rd_lambda]
        return math.exp(sum(map(math.log, last)) / len(last)) if min(last) > 0 else self.rd_lambda

    def usage(self, fitted: TrimmedDelta) -> dict[str, Any]:
        """Return what the optimisation used, and what fitting its packet gave up: raw numbers for the log."""
        return {
            "rd_lambda": self.mean_rate_weight,
            "estimate": self.estimate,
            "stopped_by_clock": self.stopped_by_clock,
            "untrimmed": fitted.untrimmed,
            "before": self.before,
            "optimise": self.optimise,
            "dropped": {"symbols": fitted.symbols, "gates": fitted.gates, "added": fitted.added},
        }

    def _measure(self) -> None:
        """Note what the last piece took."""
        now = self.budget.clock()
        self._pieces.append(now - self._piece_began)
        self._piece_began, self.optimise = now, now - self.budget.started - self.before

    def _left(self) -> float:
        """Seconds for passes since the clock was read last.

        What follows them is not known before a frame has shown it: until then it is taken for one more pass.
        """
        seconds, after = self._seconds, self.budget.after
        kept = min(self._each, UNKNOWN_RESERVE * seconds) if after is None else after
        # A run that is behind hurries to catch up: what the passes of a hurried frame leave of its time is not theirs.
        given_up = (1 - self._epoch_scale) * (seconds - kept - self.before)
        return self.budget.started + seconds - kept - self._piece_began - max(0.0, given_up)

    def _is_late(self) -> bool:
        """Say, after a view, whether the time for another one is gone."""
        usual = self._last_pass()
        if usual and self.budget.each is None and len(self._pieces) < self._views:
            self._each = self._views * mean(usual)
            made = len(self._pieces) / self._views
            self.epochs = epochs_in(self._left() + made * self._each, self._each, self._most)
        return max(usual[-3:], default=0.0) > self._left()

    def _plan_rest(self) -> None:
        """Plan the passes that are left by what the last one took."""
        self._each = self._views * mean(self._last_pass() or self._pieces)
        left = self._left()
        more = 0 if left < 0.25 * self._each else epochs_in(left, self._each, max(1, self._most - self.done))
        self.epochs = min(self.done + more, self._most)
        self.stopped_by_clock = self.epochs == self.done < self._most

    def _last_pass(self) -> list[float]:
        """Seconds of the views of the last pass, without the frame's first, which pays for what is made once."""
        return self._pieces[1:][-self._views :]


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
