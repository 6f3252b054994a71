"""What a person sees while a run works: a live line on a terminal, plain lines elsewhere."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping
from typing import Any

from gsstream.core.progress import ProgressDisplay, duration
from gsstream.engine.budget.report import violations
from gsstream.engine.run.live import latency_words

#: Seconds after which the pace of frame 0 is known well enough to announce hours.
_SURE = 10
#: A frame 0 that takes longer than this, in seconds, is announced, to those who asked for quiet too.
_LONG = 3600


class RunProgress(ProgressDisplay):
    """Frame 0 as a bar over iterations, later frames as a bar over frames with PSNR, KB, seconds and active share."""

    def __init__(self, total_frames: int | None, quiet: bool, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(quiet, clock)
        self._frames = total_frames
        self._announced = False

    def __enter__(self) -> RunProgress:
        super().__enter__()
        self.tell("reading pictures")
        return self

    def first_frame(self, iteration: int, iterations: int, loss: float, count: int) -> None:
        """Show an iteration of frame 0."""
        note = f"loss {loss:.4f}, {count} Gaussians"
        self.tell("frame 0: iteration", iteration, iterations, note)
        self._announce(iteration, iterations)
        if iteration == iterations or self.due():
            self.say(self.line())
        if iteration == iterations:
            self.tell("frame 0: writing its packet")

    def _announce(self, iteration: int, iterations: int) -> None:
        """Warn once of a frame 0 that takes hours."""
        if self._announced or self._clock() - self._began < _SURE:
            return
        left = self.left()
        if left is not None and left > _LONG:
            self._announced = True
            warnings.warn(
                f"frame 0 takes about {duration(left)} more at this pace ({iteration} of {iterations} iterations are "
                "done). Smaller pictures (--scale) and fewer iterations (--set first_frame.max_iterations=N) make it "
                "shorter",
                stacklevel=2,
            )

    def frame(self, metrics: Mapping[str, Any]) -> None:
        """Show a frame that was written."""
        self.tell("frames", int(metrics["frame"]) + 1, self._frames or 0)
        self.say(frame_line(metrics, self._frames))


def frame_line(metrics: Mapping[str, Any], total: int | None) -> str:
    """Return ``frame 3/29: 27.31 dB (moving 24.90), 8.4 KB, 0.52 s, 4.1 % sent``; ``total`` may be unknown."""
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
