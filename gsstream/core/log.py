"""FrameLog: the one record of a frame. Its phases and numbers become the frame's line in ``metrics.jsonl``.

The encoder makes one for every frame and lends it to the method and its parts (``tools.log``, ``work.log``). It is no
state: what a frame that fails has logged is lost with it.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

from gsstream.core.kinds import FITTING_SLOTS

#: The phases of a frame, in the order in which tables list them: each kind of part that fits changes by itself has one.
#: "failed" is time whose result was thrown away.
PHASES = (
    "seed",
    "change",
    *FITTING_SLOTS,
    "confidence",
    "optimise",
    "code",
    "keep",
    "key",
    "refine",
    "failed",
    "other",
)


class Mark(NamedTuple):
    """A log as it was at some time."""

    at: float
    phases: Mapping[str, float]
    numbers: Mapping[str, Any]


class FrameLog:
    """Seconds of the phases of one frame, and its numbers."""

    def __init__(self) -> None:
        self._started = time.perf_counter()
        self._phases: dict[str, float] = {}
        self._numbers: dict[str, Any] = {}
        #: For each open phase, the seconds that phases inside it have taken.
        self._inner: list[float] = []

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Add what happens inside to the phase ``name``: one of ``PHASES``, or "motion/anchors" for a part of one.

        A phase inside another is counted once: its time is taken from the outer one. A phase that is entered again
        goes on. Raises ValueError for a name that does not begin with one of ``PHASES``.
        """
        if name.partition("/")[0] not in PHASES:
            known = ", ".join(PHASES)
            raise ValueError(f"phase {name!r}: expected one of {known}, or a part of one as in 'motion/fit'")
        began = time.perf_counter()
        self._inner.append(0.0)
        try:
            yield
        finally:
            took = time.perf_counter() - began
            self._phases[name] = self._phases.get(name, 0.0) + (took - self._inner.pop())
            if self._inner:
                self._inner[-1] += took

    def set(self, **numbers: Any) -> None:
        """Write numbers of the frame, plain JSON values; a later value of the same name replaces the earlier one."""
        self._numbers.update(numbers)

    def add(self, **counts: float) -> None:
        """Add to counters; one that is not there yet begins at 0."""
        for name, count in counts.items():
            self._numbers[name] = self._numbers.get(name, 0) + count

    def mark(self) -> Mark:
        """Return the log as it is now, for :meth:`give_up`."""
        return Mark(time.perf_counter(), dict(self._phases), dict(self._numbers))

    def give_up(self, error: Exception, mark: Mark) -> None:
        """Forget an attempt that failed: all since ``mark`` is time of the phase "failed", and ``error`` is written."""
        failed = mark.phases.get("failed", 0.0) + (time.perf_counter() - mark.at)
        self._phases = {**mark.phases, "failed": failed}
        self._numbers = {**mark.numbers, "error": str(error)}

    def elapsed(self) -> float:
        """Return the seconds since the log was made."""
        return time.perf_counter() - self._started

    def seconds(self, *phases: str) -> float:
        """Return the seconds of these phases, their inner phases included."""
        return sum(took for name, took in self._phases.items() if name.partition("/")[0] in phases)

    @property
    def numbers(self) -> Mapping[str, Any]:
        """What was written so far."""
        return dict(self._numbers)

    def entry(self) -> dict[str, Any]:
        """Return the frame's line of ``metrics.jsonl``: its numbers, and ``seconds`` by phase.

        "other" is what lies in no phase. The sum of all phases is the time since the log was made.
        """
        phases = dict(self._phases)
        rest = self.elapsed() - sum(phases.values())
        phases["other"] = phases.get("other", 0.0) + max(0.0, rest)
        order = {name: place for place, name in enumerate(PHASES)}
        names = sorted(phases, key=lambda name: (order[name.partition("/")[0]], name))
        return {**self._numbers, "seconds": {name: phases[name] for name in names}}
