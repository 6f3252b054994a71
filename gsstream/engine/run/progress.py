"""What a person sees while a run works: a live line on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from gsstream.engine.budget.report import violations


class RunProgress:
    """Frame 0 as a bar over iterations, later frames as a bar over frames with PSNR, KB, seconds and active share."""

    def __init__(self, total_frames: int | None, quiet: bool) -> None:
        self._total, self._quiet = total_frames, quiet
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
        """Show an iteration of frame 0.

        Arguments:
            iteration: from 0.
            iterations: of frame 0 in all.
            loss: of this iteration.
            count: Gaussians there are.
        """
        note = f"loss {loss:.4f}, {count} Gaussians"
        if self._bar:
            if self._task is None:
                self._task = self._bar.add_task("frame 0", total=iterations, note=note)
            self._bar.update(self._task, completed=iteration, note=note)
        elif not self._quiet and (iteration == iterations or time.monotonic() - self._last > 10):
            self._last = time.monotonic()
            self.say(f"frame 0: iteration {iteration}/{iterations}, {note}")

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


def frame_line(metrics: Mapping[str, Any], total: int | None) -> str:
    """Return ``frame 3/29: 27.31 dB (moving 24.90), 8.4 KB, 0.52 s, 4.1 % active``.

    ``total`` is None while nobody knows it.
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
        parts.append(f"{100 * metrics['active_gaussians'] / metrics['num_gaussians']:.1f} % active")
    parts += [f"OVER BUDGET: {text}" for text in violations(metrics)]
    last = "" if total is None else f"/{total - 1}"
    return f"frame {metrics['frame']}{last}: " + ", ".join(parts)
