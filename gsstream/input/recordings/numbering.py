"""Which number the files of a frame have in a folder that is still being written."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path

from gsstream.input.recordings.calibration import frame_path
from gsstream.input.recordings.layouts.declared import numbers_there


class Numbering:
    """Frame -> number of its files: one after the other, without those that no camera has.

    ``patterns``: camera -> pattern of the paths of its images in ``folder``.
    """

    def __init__(self, folder: Path, patterns: Mapping[str, str]) -> None:
        self._folder, self._patterns = folder, patterns
        self._numbers = [0]  # the last one is a guess until a file of it is there

    def path(self, camera: str, frame: int) -> Path:
        """Return where a camera's image of a frame is, or is to be expected."""
        known = len(self._numbers) - 1
        number = self._numbers[frame] if frame <= known else self._numbers[known] + frame - known
        return self._folder / frame_path(self._patterns[camera], number)

    def begin(self, frame: int) -> bool:
        """Expect the number after the last one; say whether numbers were left out between the last two frames."""
        while len(self._numbers) <= frame:
            self._numbers.append(self._numbers[-1] + 1)
        return frame > 1 and self._numbers[frame - 1] > self._numbers[frame - 2] + 1

    def left_out(self, frame: int, over: bool) -> bool:
        """Whether all cameras left out the number that is expected; the frame then has their next one.

        ``over``: nothing more comes, so that the next number of any camera will do.
        """
        later = self._later(frame)
        if not later or not (over or len(later) == len(self._patterns)):
            return False
        if frame:
            warnings.warn(
                f"{self._folder}: no camera has a frame between the numbers {self._numbers[frame - 1]} and "
                f"{min(later)}; frames are counted, so that everything jumps there",
                stacklevel=2,
            )
        self._numbers[frame] = min(later)
        return True

    def goes_on(self, frame: int) -> bool:
        """Whether any camera has an image of a later frame."""
        return bool(self._later(frame))

    def _later(self, frame: int) -> list[int]:
        """The next number of every camera that has one."""
        found = (numbers_there(self._folder, pattern, self._numbers[frame]) for pattern in self._patterns.values())
        return [number for numbers in found if (number := next(numbers, None)) is not None]
