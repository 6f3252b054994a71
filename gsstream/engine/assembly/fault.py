"""The error about a part that failed: slot, part, distribution, place and frame; and the line that failed."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import entry_points, packages_distributions
from pathlib import Path
from traceback import walk_tb

from gsstream.core.errors import ComponentError
from gsstream.spec import ENTRY_POINT_GROUP


@dataclass
class Where:
    """The frame and the iteration in which parts are being called; None outside of them. One for all parts of a run."""

    frame: int | None = None
    iteration: int | None = None

    def enter(self, frame: int | None) -> None:
        """Note that a frame begins; its first iteration has not begun."""
        self.frame, self.iteration = frame, None

    def iterate(self, first: int, place: int) -> None:
        """Begin the iteration at this place of a series, of which the first has the number ``first``."""
        self.iteration = first + place

    def count(self) -> None:
        """Begin the next iteration of a part that fits something itself: the first is 1."""
        self.iteration = 1 if self.iteration is None else self.iteration + 1

    def pause(self) -> None:
        """Note that the iterations of a part have ended."""
        self.iteration = None


def fault(message: str, slot: str, part: object, where: Where | None = None) -> ComponentError:
    """Return the error about a part that raised an error or broke its contract."""
    owner = _distribution(type(part).__module__.partition(".")[0])
    place = where or Where()
    return ComponentError(
        message, slot=slot, part=type(part).__name__, distribution=owner, frame=place.frame, iteration=place.iteration
    )


def line_of(error: Exception, part: object) -> str:
    """Return the line of the part's own package that was being run, as `` (gate.py:42)``."""
    package = type(part).__module__.partition(".")[0]
    found = ""
    for frame, line in walk_tb(error.__traceback__):
        if str(frame.f_globals.get("__name__", "")).partition(".")[0] == package:
            found = f" ({Path(frame.f_code.co_filename).name}:{line})"
    return found


def _distribution(package: str) -> str:
    """Return the distribution of a top-level package. Entry points are asked first: editable installs list no files."""
    for point in entry_points(group=ENTRY_POINT_GROUP):
        if point.dist is not None and point.module.partition(".")[0] == package:
            return point.dist.name
    return packages_distributions().get(package, [package])[0]
