"""Which pictures of several cameras are of one instant. Pure: no thread, no clock of its own, no pixel is touched.

Cameras are told apart by what they say, never by how busy this machine is: an instant is complete when every camera has
a picture near it, or a later one, or has said nothing while the others were waiting for ``silence`` seconds.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import Any

#: How fast the rig's phase follows its cameras: share of their median offset per instant; the rate follows with a
#: quarter of its square (critically damped), within this share of the nominal rate.
FOLLOW, RATE_RANGE = 0.05, 0.05
#: Pictures of one camera that may wait, as a multiple of the instants: cameras may send faster than the rig's rate.
FASTER = 8
#: Offsets that the statistics remember.
REMEMBERED = 512


@dataclass(frozen=True, slots=True)
class Stamped:
    """One picture: ``time`` and ``arrival`` in seconds, of the rig's common clock and of this machine.

    ``frame`` is handed through as it came.
    """

    camera: int
    time: float
    arrival: float
    frame: Any = None


@dataclass(frozen=True, slots=True)
class Instant:
    """Pictures of one instant by camera; ``absent``: cameras without one; ``spread``: seconds from first to last."""

    index: int
    time: float
    pictures: Mapping[int, Stamped]
    absent: tuple[int, ...]
    spread: float


@dataclass(frozen=True, slots=True)
class Offset:
    """How far a camera's pictures lie from the rig's instants, seconds; positive: later."""

    median: float
    spread: float  # from the 5th to the 95th percentile
    pictures: int


@dataclass(slots=True)
class Counts:
    """What was not handed out, and why."""

    dropped: int = 0  # instants given up because too many waited
    empty: int = 0  # instants of which no camera had a picture
    late: int = 0  # pictures that came when their instant was over
    strange: int = 0  # pictures that a camera stamped far from all others, so that they only filled its queue


@dataclass(slots=True)
class _Camera:
    waiting: deque[Stamped] = field(default_factory=deque)
    heard: float = -math.inf  # arrival of its last picture
    newest: float = -math.inf  # time of its last picture
    missed: float = -math.inf  # end of the last instant that was handed out without it
    down: bool = False  # an instant waited for it in vain, and it has not been heard since
    gaps: deque[float] = field(default_factory=lambda: deque(maxlen=16))
    offsets: deque[float] = field(default_factory=lambda: deque(maxlen=REMEMBERED))


class Pairing:
    """Pictures in, whole instants out; ``poll`` depends on what was pushed and on ``now`` alone.

    Arguments:
        cameras: how many there are; pictures name them from 0.
        fps: instants per second.
        tolerance: how far from an instant its pictures may lie, as a share of the time between instants; at most 0.5,
            so that no picture belongs to two.
        silence: seconds without a picture after which nobody waits for a camera.
        depth: instants that may wait; what overflows is an instant of all cameras, never a single picture.
        together: seconds for which every camera must have sent before the first instant.
    """

    def __init__(
        self,
        cameras: int,
        fps: float,
        *,
        tolerance: float = 0.5,
        silence: float = 2.0,
        depth: int = 32,
        together: float = 2.0,
    ) -> None:
        if cameras < 1 or not 0 < fps < 1000 or not 0 < tolerance <= 0.5 or silence <= 0 or depth < 1 or together < 0:
            raise ValueError(
                f"expected at least one camera, fps below 1000, tolerance in (0, 0.5], silence > 0, depth >= 1 and "
                f"together >= 0, got {cameras}, {fps}, {tolerance}, {silence}, {depth} and {together}"
            )
        self._nominal = self._period = 1 / fps
        self._tolerance, self._silence, self._depth, self._together = tolerance, silence, depth, together
        self._cameras = [_Camera() for _ in range(cameras)]
        #: Most pictures of one camera that wait; before the first instant they span ``together``.
        self._most = FASTER * max(depth, math.ceil(together * fps) + 2)
        self._due: float | None = None
        self._index = 0
        self.counts = Counts()

    @property
    def capacity(self) -> int:
        """Most pictures that wait, of all cameras: what bounds the memory."""
        return self._most * len(self._cameras)

    @property
    def started(self) -> bool:
        """Whether there was a first instant, or one is about to be."""
        return self._due is not None

    def push(self, picture: Stamped) -> None:
        """Take one picture, O(log n) or better; pictures of one camera come in the order of their times."""
        camera = self._cameras[picture.camera]
        camera.heard, camera.down = max(camera.heard, picture.arrival), False
        if picture.time <= camera.newest:
            self.counts.strange += 1  # its clock went back: what waits was stamped by another one
            camera.waiting.clear()
        elif camera.newest > -math.inf:
            camera.gaps.append(picture.time - camera.newest)
        camera.newest = picture.time
        if self._due is not None and picture.time < self._due - self._reach:
            self.counts.late += picture.time <= camera.missed
            return
        camera.waiting.append(picture)
        self._bound(camera)

    def poll(self, now: float) -> Instant | None:
        """Return the next complete instant, or None while it has to be waited for; ``now`` as ``arrival``."""
        if self._due is None and not self._begin():
            return None
        while True:
            assert self._due is not None, "begun"
            near = [self._nearest(camera) for camera in self._cameras]
            since = min((picture.arrival for picture in near if picture is not None), default=now)
            if not all(self._settled(c, p, now, since) for c, p in zip(self._cameras, near, strict=True)):
                return None
            if any(near):
                break
            if not self._skip():
                return None
        return self._hand_out({i: picture for i, picture in enumerate(near) if picture is not None})

    def offsets(self) -> Mapping[int, Offset]:
        """Return the offset of each camera against the rig, of its last 512 pictures; without any it is left out."""
        return {i: _offset(camera.offsets) for i, camera in enumerate(self._cameras) if camera.offsets}

    @property
    def fps(self) -> float:
        """Instants per second as the cameras send them, which the nominal rate follows within 5 %."""
        return 1 / self._period

    @property
    def _reach(self) -> float:
        return self._tolerance * self._period

    def _begin(self) -> bool:
        """Find the rig's phase as soon as every camera has sent for long enough."""
        firsts = [camera.waiting[0].time if camera.waiting else math.inf for camera in self._cameras]
        start = max(firsts)
        if math.isinf(start) or min(camera.newest for camera in self._cameras) < start + self._together:
            return False
        self._period = self._seen_period()
        phases = []  # nothing before the latest camera's first picture can become whole
        for camera in self._cameras:
            times = [picture.time for picture in camera.waiting if picture.time >= start]
            phases.append(_middle_phase(times, self._period, start))
        self._due = start + _middle_phase(phases, self._period, 0.0)
        self._forget()
        return True

    def _seen_period(self) -> float:
        """Return the period of most cameras, or of several of their pictures, where it is within the range."""
        seen = []
        for camera in self._cameras:
            times = [picture.time for picture in camera.waiting]
            gap = (times[-1] - times[0]) / max(1, len(times) - 1)
            whole = gap * max(1, round(self._nominal / gap)) if gap > 0 else self._nominal
            lost = any(b - a > 1.5 * gap for a, b in itertools.pairwise(times))
            off = abs(whole / self._nominal - 1) > RATE_RANGE
            seen.append(self._nominal if lost or off or len(times) < 8 else whole)
        return median(seen)

    def _nearest(self, camera: _Camera) -> Stamped | None:
        assert self._due is not None, "begun"
        due, best = self._due, None
        for picture in camera.waiting:
            if picture.time > due + self._reach:
                break
            if best is None or abs(picture.time - due) < abs(best.time - due):
                best = picture
        return best if best is not None and abs(best.time - due) <= self._reach else None

    def _settled(self, camera: _Camera, near: Stamped | None, now: float, since: float) -> bool:
        """Whether nothing that this camera may still send could be nearer; the others have waited since ``since``."""
        assert self._due is not None, "begun"
        if now - max(camera.heard, since) > self._silence:
            camera.down = True
        if camera.down:
            return True
        if near is None:
            return camera.newest > self._due + self._reach
        usual = min(median(camera.gaps), self._period) if camera.gaps else self._period
        return camera.newest >= self._due or self._due - near.time <= usual / 2

    def _skip(self) -> bool:
        """Pass over the instants of which nobody has a picture; False: there is none."""
        assert self._due is not None, "begun"
        waiting = [camera for camera in self._cameras if camera.waiting]
        if not waiting:
            return False
        first = min(waiting, key=lambda camera: camera.waiting[0].time)
        oldest = first.waiting[0].time
        steps = math.ceil((oldest - self._due) / self._period - self._tolerance)
        if steps < 1:
            return False
        self.counts.empty += steps
        self._due += steps * self._period
        if steps > self._depth:
            # The phase has drifted: where this camera lies in an instant is known better.
            self._due = oldest - (median(first.offsets) if first.offsets else 0.0)
        self._forget()
        return True

    def _hand_out(self, pictures: dict[int, Stamped]) -> Instant:
        assert self._due is not None, "begun"
        times = [picture.time for picture in pictures.values()]
        absent = tuple(i for i in range(len(self._cameras)) if i not in pictures)
        instant = Instant(self._index, self._due, pictures, absent, max(times) - min(times))
        for i in absent:
            self._cameras[i].missed = self._due + self._reach
        self._index += 1
        self._advance(pictures)
        return instant

    def _advance(self, pictures: dict[int, Stamped]) -> None:
        """Go on to the next instant; phase and rate follow the pictures of this one, which are let go of."""
        assert self._due is not None, "begun"
        for i, picture in pictures.items():
            self._cameras[i].offsets.append(picture.time - self._due)
        off = median(picture.time for picture in pictures.values()) - self._due
        bent = self._period + FOLLOW * FOLLOW / 4 * off
        low, high = (self._nominal * (1 + sign * RATE_RANGE) for sign in (-1, 1))
        self._period = min(max(bent, low), high)
        self._due += self._period + FOLLOW * off
        for i, picture in pictures.items():
            waiting = self._cameras[i].waiting
            while waiting and waiting[0].time <= picture.time:
                waiting.popleft()
        self._forget()

    def _forget(self) -> None:
        """Let go of pictures that no instant can take any more."""
        assert self._due is not None, "begun"
        for camera in self._cameras:
            while camera.waiting and camera.waiting[0].time < self._due - self._reach:
                camera.waiting.popleft()

    def _bound(self, camera: _Camera) -> None:
        """Keep within ``depth`` instants and the capacity: the oldest instant goes, for all cameras."""
        if self._due is None:
            # Before the first instant only the last seconds matter.
            keep = max(self._together, self._nominal) + self._depth * self._nominal
            while camera.waiting[0].time < camera.newest - keep or len(camera.waiting) > self._most:
                camera.waiting.popleft()
            return
        until = self._lagging() - self._depth * self._period
        while min((c.waiting[0].time for c in self._cameras if c.waiting), default=math.inf) < until:
            if not self._skip():
                near = [self._nearest(c) for c in self._cameras]
                self._advance({i: picture for i, picture in enumerate(near) if picture is not None})
                self.counts.dropped += 1
        while len(camera.waiting) > self._most:
            camera.waiting.popleft()
            self.counts.strange += 1

    def _lagging(self) -> float:
        """Time up to which most cameras have sent: one that stamps the far future drops nothing."""
        newest: Sequence[float] = sorted(camera.newest for camera in self._cameras)
        return newest[(len(newest) - 1) // 2]


def _middle_phase(times: Sequence[float], period: float, start: float) -> float:
    """Return the median place of times in their period, in [0, period), unrolled at the largest gap between places."""
    places = sorted((time - start) % period for time in times)
    gaps = [(places[i] - places[i - 1]) % period if i else places[0] - places[-1] + period for i in range(len(places))]
    first = gaps.index(max(gaps))
    unrolled = [*places[first:], *(place + period for place in places[:first])]
    return median(unrolled) % period


def _offset(offsets: Sequence[float]) -> Offset:
    ordered = sorted(offsets)
    last = len(ordered) - 1
    return Offset(median(ordered), ordered[round(0.95 * last)] - ordered[round(0.05 * last)], len(ordered))
