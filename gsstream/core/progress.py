"""Progress of long work: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    from rich.progress import Progress

#: Name of the work, number of its steps that are done, and of all its steps; 0 where the number is unknown.
Tell = Callable[[str, int, int], None]
#: Seconds after which a line is printed though nothing has changed; the next ones take twice as long each. With the
#: time that it takes to wake up, no more than five seconds lie between two lines about work that goes on.
EVERY = 4.0
#: Seconds of work after which its pace counts as known.
PACE = 2.0


def silent(_what: str, _done: int, _total: int) -> None:
    """Show no progress: the callback of callers that want none."""


def duration(seconds: float) -> str:
    """Return a length of time in the unit that a person would use."""
    for unit, length in (("hours", 3600), ("minutes", 60)):
        if seconds >= 2 * length:
            return f"{seconds / length:.1f} {unit}" if seconds < 10 * length else f"{seconds / length:.0f} {unit}"
    return f"{seconds:.0f} seconds"


class ProgressDisplay:
    """A bar with count and time left on a terminal; elsewhere a line every few seconds, as long as this is open.

    Work that ends before the first line is due prints nothing.
    """

    #: Times, by the clock, at which an earlier display was closed last and had printed its last line.
    _before: ClassVar[tuple[float, float]] = (-1.0, -1.0)

    def __init__(self, quiet: bool, clock: Callable[[], float] = time.monotonic) -> None:
        from rich.console import Console

        self._quiet, self._clock = quiet, clock
        self._console = Console(stderr=True)
        self._live = not quiet and sys.stderr.isatty()
        self._bar: Progress | None = None
        self._task: Any = None
        self._lock, self._over = threading.RLock(), threading.Event()
        self._thread: threading.Thread | None = None
        self._what, self._done, self._total, self._note = "", 0, 0, ""
        self._began = self._changed = self._printed = clock()
        self._first = 0

    def __enter__(self) -> ProgressDisplay:
        # A display that follows another one at once counts its silence from the last line of that one.
        closed, printed = ProgressDisplay._before
        self._printed = printed if 0 <= self._clock() - closed < 1 else self._clock()
        if self._live:
            from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                TextColumn("{task.fields[count]}"),
                TextColumn("{task.fields[note]}"),
                TimeElapsedColumn(),
                TextColumn("gone,"),
                TimeRemainingColumn(),
                TextColumn("left"),
                console=self._console,
            )
            self._bar.start()
        elif not self._quiet:
            self._thread = threading.Thread(target=self._watch, daemon=True)
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        ProgressDisplay._before = self._clock(), self._printed
        self._over.set()
        if self._bar:
            self._bar.stop()
        if self._thread:
            self._thread.join()

    def tell(self, what: str, done: int = 0, total: int = 0, note: str = "") -> None:
        """Show ``what`` as the present work, with ``done`` of ``total`` steps; a line is printed when it is due."""
        with self._lock:
            now, new = self._clock(), what != self._what
            if new:
                self._began, self._first = now, done
            if new or done != self._done:
                self._changed = now
            self._what, self._done, self._total, self._note = what, done, total, note
        if self._bar:
            if new and self._task is not None:
                self._bar.remove_task(self._task)
                self._task = None
            count = f"{done}/{total}" if total else ""
            if self._task is None:
                self._task = self._bar.add_task(what, total=total or None, count=count, note=note)
            self._bar.update(self._task, completed=done, count=count, note=note)

    def left(self) -> float | None:
        """Return how many seconds the rest takes at the pace so far; None while that is unknown."""
        gone = self._clock() - self._began
        if gone < PACE or self._done <= self._first or not self._total:
            return None
        return gone / (self._done - self._first) * (self._total - self._done)

    def line(self) -> str:
        """Return the present work in one line."""
        parts = [f"{self._what} {self._done}/{self._total}" if self._total else self._what]
        parts += [self._note] if self._note else []
        waited, left = self._clock() - self._changed, self.left()
        if waited >= EVERY:
            parts.append(f"{duration(waited)} so far" if not self._total else f"{duration(waited)} on this one")
        elif left:
            parts.append(f"about {duration(left)} left")
        return ", ".join(parts)

    def say(self, line: str) -> None:
        """Print one plain line, unless quiet."""
        if not self._quiet:
            with self._lock:
                self._printed = self._clock()
                console = self._bar.console if self._bar else self._console
                console.print(line, highlight=False, markup=False, soft_wrap=True)

    def due(self) -> bool:
        """Whether it is time for another plain line: of work in which nothing changes, after twice the time each."""
        pause = max(EVERY, self._printed - self._changed)
        return not self._quiet and self._bar is None and self._clock() - self._printed >= pause

    def _watch(self) -> None:
        while not self._over.wait(0.25):
            if self._what and self.due():
                self.say(self.line())
