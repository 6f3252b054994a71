"""How many frames of a growing folder wait behind the one in turn, and what the policy of a run makes of them."""

from __future__ import annotations

from collections.abc import Callable, Set
from pathlib import Path

from gsstream.input.recordings.options import WatchOptions


class Backlog:
    """The frames that have come of all training cameras.

    Arguments:
        path: place of a camera's image of a frame.
        train: the training cameras.
        declared: number of frames, where the recording says it.
        options: ``behind``, ``queue`` and ``min_epoch_scale``.
    """

    def __init__(
        self, path: Callable[[str, int], Path], train: Set[str], declared: int | None, options: WatchOptions
    ) -> None:
        self._path, self._train, self._options = path, train, options
        self._last = float("inf") if declared is None else declared - 1
        self._newest = 0
        #: Cameras that the last frame was made without; and the frame up to which the run skips.
        self.gone: Set[str] = frozenset()
        self.skip_to = 0

    def behind(self, index: int) -> int:
        """Return how many frames after this one have come."""
        newest = max(self._newest, index)
        # What a camera that is gone does not send keeps no frame from having come.
        names = self._train - self.gone or self._train
        while newest < self._last and all(self._path(name, newest + 1).exists() for name in names):
            newest += 1
        self._newest = newest  # the frame that is read ahead is planned at the same time: two counts must not add up
        return newest - index

    def effort(self, index: int) -> float:
        """Return 1 while the run keeps up; less when more frames wait than the queue may hold."""
        if self._options.behind == "block":
            return 1.0
        if index < self.skip_to:
            return 0.0
        waiting = self.behind(index)
        if waiting <= self._options.queue:
            return 1.0
        if self._options.behind == "hurry":
            return max(self._options.min_epoch_scale, self._options.queue / waiting)
        self.skip_to = index + waiting
        return 0.0
