"""What a person sees while a run works: a live line on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable, Mapping
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from gsstream.engine.budget.report import violations
from gsstream.engine.run.live import latency_words

#: Seconds between plain lines, and those after which the pace of frame 0 is known.
_EVERY = 10
#: A frame 0 that takes longer than this, in seconds, is announced, to those who asked for quiet too.
_LONG = 3600


class RunProgress:
    """Frame 0 as a bar over iterations, later frames as a bar over frames with PSNR, KB, seconds and active share."""

    def __init__(
        self, total_frames: int | None, quiet: bool, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._total, self._quiet, self._clock = total_frames, quiet, clock
        self._begun: tuple[int, float] | None = None
        self._announced = False
        self._console = Console(stderr=True)
        self._live = not quiet and sys.stderr.isatty()
        self._bar: Progress | None = None
        self._task: Any = None
        self._last = 0.0

    def __enter__(self) -> RunProgress:
        if self._live:
            columns = [TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed}/{task.total}")]
            self._bar = Progress(
                *columns, TextColumn("{task.fields[note]}"), TimeElapsedColumn(), TextColumn("gone,"),
                TimeRemainingColumn(), TextColumn("left"), console=self._console,
            )  # fmt: skip
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar:
            self._bar.stop()

    def first_frame(self, iteration: int, iterations: int, loss: float, count: int) -> None:
        """Show an iteration of frame 0."""
        note = f"loss {loss:.4f}, {count} Gaussians"
        now, left = self._clock(), self._seconds_left(iteration, iterations)
        if left is not None and left > _LONG and not self._announced:
            self._announced = True
            warnings.warn(
                f"frame 0 takes about {_duration(left)} more at this pace ({iteration} of {iterations} iterations are "
                "done). Smaller pictures (--scale) and fewer iterations (--set first_frame.max_iterations=N) make it "
                "shorter", stacklevel=2
            )  # fmt: skip
        if self._bar:
            if self._task is None:
                self._task = self._bar.add_task("frame 0", total=iterations, note=note)
            self._bar.update(self._task, completed=iteration, note=note)
        elif not self._quiet and (iteration == iterations or now - self._last > _EVERY):
            self._last = now
            rest = f", about {_duration(left)} left" if left else ""
            self.say(f"frame 0: iteration {iteration}/{iterations}, {note}{rest}")

    def _seconds_left(self, iteration: int, iterations: int) -> float | None:
        """Return how long the iterations that are left take at the pace so far; None while it is unknown."""
        if self._begun is None:
            self._begun = (iteration, self._clock())
        first, begun = self._begun
        gone = self._clock() - begun
        return None if gone < _EVERY or iteration == first else gone / (iteration - first) * (iterations - iteration)

    def frame(self, metrics: Mapping[str, Any]) -> None:
        """Show a frame that was written."""
        index = int(metrics["frame"])
        if index == 0 and self._bar and self._task is not None:
            self._bar.remove_task(self._task)
            self._task = self._bar.add_task("frames", total=self._total, note="")
        line = frame_line(metrics, self._total)
        if self._bar:
            if self._task is None:
                self._task = self._bar.add_task("frames", total=self._total, note="")
            self._bar.update(self._task, completed=index + 1, note="")
        self.say(line)

    def say(self, line: str) -> None:
        """Print one plain line, unless quiet."""
        if not self._quiet:
            console = self._bar.console if self._bar else self._console
            console.print(line, highlight=False, markup=False, soft_wrap=True)


def _duration(seconds: float) -> str:
    for unit, length in (("hours", 3600), ("minutes", 60)):
        if seconds >= 2 * length:
            return f"{seconds / length:.1f} {unit}" if seconds < 10 * length else f"{seconds / length:.0f} {unit}"
    return f"{seconds:.0f} seconds"


def frame_line(metrics: Mapping[str, Any], total: int | None) -> str:
    """Return ``frame 3/29: 27.31 dB (moving 24.90), 8.4 KB, 0.52 s, 4.1 % sent``.

    ``total`` is None while it is unknown.
    """
    values = [v for v in metrics.get("psnr", {}).values() if v is not None]
    moving = [v for v in metrics.get("psnr_moving", {}).values() if v is not None]
    parts = []
    if values:
        extra = f" (moving {sum(moving) / len(moving):.2f})" if moving else ""
        parts.append(f"{sum(values) / len(values):.2f} dB{extra}")
    size = sum(metrics["bytes"].values())
    parts.append(f"{size / 1000:.1f} KB" if size >= 100 else f"{size} B")
    parts.append(f"{sum(metrics['seconds'].values()):.2f} s")
    if metrics["num_gaussians"]:
        parts.append(f"{100 * metrics['sent_gaussians'] / metrics['num_gaussians']:.1f} % sent")
    parts += latency_words(metrics)
    parts += [f"OVER BUDGET: {text}" for text in violations(metrics)]
    last = "" if total is None else f"/{total - 1}"
    return f"frame {metrics['frame']}{last}: " + ", ".join(parts)
