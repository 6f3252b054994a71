"""When a frame has gained what it can: early stopping by what an epoch still gains (ours).

Epochs of one frame cost alike, so gain per epoch is gain per second; measured in the loss alone, never with a clock, so
that a run gives the same bytes on every machine and after every resume.
"""

from __future__ import annotations

import torch


class Gains:
    """What a frame's epochs have gained. Lives inside one frame's optimisation."""

    def __init__(self, views: int) -> None:
        self._last: dict[int, tuple[float, int]] = {}
        self._views = views
        self._epoch: list[float] = []
        self._total = 0.0

    def note(self, view: int, loss: float, tiles: int) -> None:
        """Loss of one view as a sum over ``tiles`` tiles; losses over other tiles than last time do not compare."""
        before = self._last.get(view)
        if before is not None and before[1] == tiles:
            self._epoch.append(before[0] - loss)
        self._last[view] = (loss, tiles)

    def end_epoch(self) -> float:
        """Gain of this epoch as a share of what the frame has gained so far; 1 while too few views compare."""
        gain, known = sum(self._epoch), len(self._epoch)
        self._epoch = []
        if 2 * known < self._views:
            return 1.0
        gain = max(0.0, gain * self._views / known)
        self._total += gain
        return gain / self._total if self._total > 0 else 0.0


def watch(watched: torch.Tensor | None, tiles: torch.Tensor) -> torch.Tensor:
    """Tiles a view is judged on: those in use and a margin, kept until something moves out of them.

    Arguments:
        watched: [rows, columns] bool of the last time. tiles: those that this render touched.
    """
    if watched is not None and not bool((tiles & ~watched).any()):
        return watched
    grown = torch.nn.functional.max_pool2d(tiles[None].float(), 3, 1, 1)[0] > 0
    return grown if watched is None else watched | grown
