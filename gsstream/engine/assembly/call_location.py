"""Where a run is: the place that an error about a part names."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Where:
    """The frame and the iteration in which parts are being called; None outside of them. One for all parts of a run."""

    frame: int | None = None
    iteration: int | None = None

    def enter(self, frame: int | None) -> None:
        """Begin a frame; no iteration of it has begun."""
        self.frame, self.iteration = frame, None

    def iterate(self, first: int, place: int) -> None:
        """Begin the iteration at this place of a series, of which the first has the number ``first``."""
        self.iteration = first + place

    def count(self) -> None:
        """Begin the next iteration of a part that fits something itself: the first is 1."""
        self.iteration = 1 if self.iteration is None else self.iteration + 1

    def pause(self) -> None:
        """Note that no iteration goes on: a part has ended its own."""
        self.iteration = None
