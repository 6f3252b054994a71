"""What one frame may cost: the numbers that its work reads, and the clock that it is held against."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace


@dataclass(frozen=True, slots=True)
class FrameBudget:
    """The limits of one frame, and the settings that keep it inside them. Without a limit: the recipe's own numbers.

    A packet beyond ``max_bytes`` is sent and counted as a violation.

    Arguments:
        epochs: passes over the training cameras, at least 1; under a limit on time a prediction, corrected in every
            pass.
        change_threshold: spreads of the noise by which a tile must differ to count as changed; 0: every tile counts.
        rd_lambda: loss per bit of the residual at the start; moved after every pass where a size is to be met.
        max_bytes: bytes of the packet, headers included; None: no limit.
        seconds: what may be planned with from the start of the frame; None: no limit.
        step_scale: factor on quantisation steps, at least 1.
        part_scale: share of their usual passes that motion and growth make, above 0 to 1; less than 1 only in frames
            without a residual.
        max_epochs: passes that are not exceeded however much time is left.
        after: seconds to keep for what follows the passes; None: unknown, the frame's own passes will tell.
        each: seconds that a pass has taken with ``candidates`` Gaussians; None while nothing is known.
        candidates: how many Gaussians took part in the frame that ``each`` is known from.
        correction: real bytes per estimated byte.
        predicted_seconds: what the frame is expected to take; None while nothing is known.
        predicted_bytes: size that is expected of the packet before it is trimmed; None while nothing is known.
        started: start of the frame, by ``clock``.
        clock: returns seconds.
    """

    epochs: int
    change_threshold: float
    rd_lambda: float
    max_bytes: int | None = None
    seconds: float | None = None
    step_scale: float = 1.0
    part_scale: float = 1.0
    max_epochs: int = 0
    after: float | None = None
    each: float | None = None
    candidates: int = 0
    correction: float = 1.0
    predicted_seconds: float | None = None
    predicted_bytes: float | None = None
    started: float = 0.0
    clock: Callable[[], float] = time.perf_counter

    @property
    def is_limited(self) -> bool:
        """Whether there is a limit on bytes or on time."""
        return self.max_bytes is not None or self.seconds is not None

    def at_most(self, epochs: int) -> FrameBudget:
        """Return a budget of no more than so many passes, however much time is left."""
        return replace(self, epochs=min(epochs, self.epochs), max_epochs=min(epochs, self.max_epochs))

    def seconds_left(self) -> float | None:
        """Return the seconds until the frame should be over, by the budget's clock; None: no limit."""
        return None if self.seconds is None else self.started + self.seconds - self.clock()
