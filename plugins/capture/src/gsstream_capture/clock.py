"""When a picture was taken, by what its sender says. Pure: arrival times are handed in.

A camera's reports (RTCP) tie its stamps to its own wall clock. The first report of a sender was seen 2.2 s off until
its second, so a clock is trusted after two; a step of a trusted clock begins anew.
"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass, field
from statistics import median
from typing import Literal

#: How a picture's time was found. sender: the camera's clock, which agrees with this machine's. steadied: the camera's
#: clock shifted by the shortest way of its pictures, because the two clocks do not agree. arrival: when it came.
ClockKind = Literal["sender", "steadied", "arrival"]
#: Seconds that a picture may have been on its way when its clock counts as set; and seconds that it may come early.
SLOWEST, EARLY = 2.0, 0.25
#: Seconds after which a camera without reports is taken by arrival.
PATIENCE = 8.0
#: What this machine's wall clock said at a moment of its steady clock: a step of it later moves no picture.
_WALL, _STEADY = time.time(), time.monotonic()


def here() -> float:
    """Return seconds since 1970 by this machine, which never go back."""
    return _WALL + time.monotonic() - _STEADY


@dataclass(slots=True)
class SenderClock:
    """The clock of one camera since it was opened.

    Arguments:
        step: seconds by which two reports of a trusted clock may differ; half a frame of the rig.
        reports: whether the way over which pictures come has reports at all (RTSP); others go by arrival at once.
        before: ``usual`` of the connection before; a first report that agrees with it is trusted as a second one.
    """

    step: float
    reports: bool = True
    before: float | None = None
    kind: ClockKind | None = None
    restarts: int = 0
    _opened: float | None = None
    _reports: int = 0
    _tie: float | None = None  # sender's wall clock minus the stamp of the stream
    _ways: deque[float] = field(default_factory=lambda: deque(maxlen=256))

    def observe(self, stamp: float | None, wall: float | None, *, report: bool, arrival: float) -> float | None:
        """Take one picture and return its time in seconds; None while its clock is not trusted.

        Arguments:
            stamp: place of the picture in its stream, seconds; None where the container gives none.
            wall: when the sender says that it was taken, seconds of the sender's clock; None: it says nothing.
            report: whether a report of the sender came with this picture.
            arrival: when it came here, seconds of this machine's clock.
        """
        self._opened = arrival if self._opened is None else self._opened
        if not self.reports:
            self.kind = "arrival"
            return arrival
        if wall is None or stamp is None:
            if self._tie is None and (self.kind == "arrival" or arrival - self._opened > PATIENCE):
                self.kind = "arrival"
                return arrival
            return None
        self._agree(wall - stamp, report)
        if self._reports == 1 and self.before is not None and abs(arrival - wall - self.before) < self.step:
            self._reports = 2
        if self._reports < 2:
            self.kind = None
            return None
        self._ways.append(arrival - wall)
        usual = median(self._ways)
        if -EARLY <= usual <= SLOWEST:
            self.kind = "sender"
            return wall
        self.kind = "steadied"
        return wall + min(self._ways)

    @property
    def usual(self) -> float | None:
        """Median seconds from a picture's time by the sender to its arrival here; None while none is known."""
        return median(self._ways) if self._ways else self.before

    def _agree(self, tie: float, report: bool) -> None:
        """Count reports. Without network and load in it, a tie moves by a step of the clock alone."""
        if self._tie is not None and abs(tie - self._tie) > self.step:
            trusted = self._reports >= 2
            self.restarts += trusted
            self._reports = 1 if trusted else self._reports + 1
            self._ways.clear()
        elif self._tie is None or report:
            self._reports += 1
        self._tie = tie
