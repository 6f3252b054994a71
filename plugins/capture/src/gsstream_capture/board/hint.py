"""While a take is recorded: how often each camera saw the board, and where in its picture the board has not been."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from gsstream_capture.board.design import Board, Finder, Sighting

#: Cells of a picture's width and height; share of them that a lens take should cover.
CELLS, COVER = 4, 0.6
#: Seconds between two looks at one camera: finding a board takes a few hundredths.
EVERY = 0.5
_DOWN, _ACROSS = ("upper", "upper", "lower", "lower"), ("left", "left", "right", "right")


class Hint:
    """Looks at some of the pictures of each camera."""

    def __init__(self, board: Board, names: Sequence[str]) -> None:
        self._finder, self._names = Finder(board), names
        self.pictures = [0] * len(names)
        self._cells = np.zeros((len(names), CELLS, CELLS), bool)
        self._looked = [0.0] * len(names)

    def look(self, camera: int, pixels: Any) -> None:
        """Look for the board in [H, W, 3] uint8, at most twice a second."""
        now = time.monotonic()
        if now - self._looked[camera] < EVERY:
            return
        self._looked[camera] = now
        if (found := self._finder.find(pixels)) is not None:
            self.saw(camera, found, (pixels.shape[1], pixels.shape[0]))

    def saw(self, camera: int, found: Sighting, size: tuple[int, int]) -> None:
        """Count a picture of the board."""
        self.pictures[camera] += 1
        cells = np.clip((found.places / np.array(size) * CELLS).astype(int), 0, CELLS - 1)
        self._cells[camera, cells[:, 1], cells[:, 0]] = True

    def covered(self, camera: int) -> float:
        """Return the share of a camera's picture in which the board has been."""
        return float(self._cells[camera].mean())

    def lines(self) -> list[str]:
        """Return a line for each camera."""
        return [
            f"{name}: {self.pictures[c]} pictures of the board, {100 * self.covered(c):.0f} % covered{self._lacks(c)}"
            for c, name in enumerate(self._names)
        ]

    def _lacks(self, camera: int) -> str:
        if self.covered(camera) >= COVER:
            return ""
        counts: dict[str, int] = {}
        for row, column in np.argwhere(~self._cells[camera]):
            place = f"{_DOWN[row]} {_ACROSS[column]}"
            counts[place] = counts.get(place, 0) + 1
        return f"; lacks the {max(counts, key=lambda place: counts[place])}"
