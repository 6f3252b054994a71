"""One camera: opened, read, stamped, and opened again when it dies. A thread that never raises; it says its state."""

from __future__ import annotations

import struct
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import av
import av.error

from gsstream_capture.clock import ClockKind, SenderClock, here
from gsstream_capture.gathering import WHOLE, Gathering
from gsstream_capture.pairing import Stamped
from gsstream_capture.rig import CameraSpec, Opening, without_secrets

State = Literal["opening", "live", "silent", "refused", "ended"]
#: Seconds for opening, and for reading a packet: FFmpeg waits for it twice, so a camera counts as silent after three.
OPEN, READ = 8.0, 1.5
#: Seconds until it is opened again, the last one ever after.
PAUSES = (0.5, 1.0, 2.0, 4.0, 8.0)
#: Pictures in turn that may be damaged before the connection is made anew.
MOST_DAMAGED = 100


@dataclass
class Health:
    """What is known of a camera; written by its thread, read by anybody."""

    state: State = "opening"
    why: str = ""  # of the last failure, without passwords
    size: tuple[int, int] | None = None  # (width, height) of its pictures as they come
    clock: ClockKind | None = None
    opened: int = 0
    pictures: int = 0
    damaged: int = 0
    restarts: int = 0  # steps of its clock
    last: float = 0.0  # arrival of its last picture
    stamps: deque[float] = field(
        default_factory=lambda: deque(maxlen=64)
    )  # places of the last in their stream, seconds
    keys: deque[float] = field(default_factory=lambda: deque(maxlen=8))  # arrivals of its last key pictures
    ways: deque[float] = field(default_factory=lambda: deque(maxlen=512))  # arrival minus time, seconds

    @property
    def fps(self) -> float:
        """Pictures per second, of the last 64 by their own stamps; 0 while there are none."""
        span = self.stamps[-1] - self.stamps[0] if self.stamps else 0.0
        return (len(self.stamps) - 1) / span if span > 0 else 0.0


class Damaged(Exception):
    """Too much of what came could not be decoded."""


class CameraReader(threading.Thread):
    """Reads one camera until ``stop``; pictures go to ``deliver``, which is called from this thread.

    Arguments:
        number: of the camera in the rig.
        spec, opening: what the rig file says of it, and how PyAV opens it.
        deliver: takes every picture whose time is known, as a decoded frame that no colours were made of.
        step: seconds by which its clock may move between reports.
        by_clock: False pairs it by arrival, whatever its sender says.
        began: when files begin to play, by :func:`gsstream_capture.clock.here`.
    """

    def __init__(
        self,
        number: int,
        spec: CameraSpec,
        opening: Opening,
        deliver: Callable[[Stamped], None],
        *,
        step: float,
        by_clock: bool = True,
        began: float = 0.0,
    ) -> None:
        super().__init__(name=f"camera {spec.id}", daemon=True)
        self.number, self.spec, self.health = number, spec, Health()
        self._opening, self._deliver, self._step = opening, deliver, step
        self._by_clock, self._began = by_clock, began or here()
        self._halt = threading.Event()
        self._clock: SenderClock | None = None  # of the connection that is, or was last

    def stop(self) -> None:
        """End as soon as the next packet or the time limit of reading allows."""
        self._halt.set()

    def run(self) -> None:
        """Read, and open again after a failure, until ``stop`` or the end of a file."""
        failures = 0
        while not self._halt.is_set():
            before = self.health.pictures
            try:
                self._read()
                if self._opening.kind == "file":
                    self.health.state = "ended"
                    return
                self._failed("the camera ended its stream")
            except (av.error.FFmpegError, OSError, ValueError, Damaged, IndexError) as error:
                self._failed(str(error))
            failures = 0 if self.health.pictures > before else failures + 1
            self._halt.wait(PAUSES[min(failures, len(PAUSES) - 1)])

    def _failed(self, why: str) -> None:
        self.health.why = without_secrets(why, [self.spec.url])
        if self.health.state != "refused":
            self.health.state = "silent"

    def _read(self) -> None:
        opening = self._opening
        with av.open(opening.target, format=opening.format, options=dict(opening.options), timeout=(OPEN, READ)) as box:
            stream = box.streams.video[0]
            stream.codec_context.thread_count = 1
            if opening.kind != "file":
                stream.codec_context.options = {"flags": "low_delay"}
            self.health.opened += 1
            before = None if self._clock is None else self._clock.usual
            self._clock = SenderClock(self._step, self._by_clock and opening.kind == "rtsp", before)
            walls: dict[int | None, float | None] = {}
            reported, broken, sound = False, 0, False
            pieced = opening.kind == "rtsp" and stream.codec_context.name not in WHOLE
            gathering = Gathering(stream.codec_context.name) if pieced else None
            for packet in box.demux(stream):
                if self._halt.is_set():
                    return
                walls[packet.pts] = self._wall(packet)
                reported = reported or bool(packet.get_sidedata("rtcp_sr"))
                for picture, key, cut in _whole(packet, gathering):
                    frames, fault = ([], True) if cut else _decoded(stream.codec_context, picture)
                    if key or any(frame.key_frame for frame in frames):
                        sound = True
                        self.health.keys.append(here())
                    if fault:
                        # What is predicted from a damaged picture is damaged, until the next key picture.
                        sound, broken = False, broken + 1
                        self.health.damaged += 1
                        if broken > MOST_DAMAGED:
                            raise Damaged(f"{broken} pictures in turn could not be decoded")
                    for frame in frames if sound else ():
                        broken = 0
                        if self._take(frame, walls, self._clock, reported):
                            reported = False
                if len(walls) > 64:
                    walls.clear()

    def _wall(self, packet: Any) -> float | None:
        """When the sender says that a packet's picture was taken (AVProducerReferenceTime, by RTCP reports)."""
        if self._opening.kind != "rtsp":
            return None
        side = packet.get_sidedata("prft")
        return struct.unpack_from("<q", bytes(side))[0] / 1e6 if side else None

    def _take(self, frame: Any, walls: dict[int | None, float | None], clock: SenderClock, reported: bool) -> bool:
        """Stamp a picture and hand it on; returns whether the clock has seen it."""
        health, stamp = self.health, None if frame.pts is None else float(frame.pts * frame.time_base)
        size = (frame.width, frame.height)
        if health.size is not None and health.size != size:
            health.state = "refused"
            raise ValueError(
                f"its pictures are {size[0]} x {size[1]}, they were {health.size[0]} x {health.size[1]}; set the "
                "camera back, or begin the capture anew"
            )
        if self._opening.kind == "file" and stamp is not None:
            taken: float | None = self._began + stamp
            self._halt.wait(max(0.0, self._began + stamp - here()))
            health.clock = "sender"
        elif self._opening.kind == "device" and stamp is not None and self._by_clock:
            taken, health.clock = stamp, "sender"
        else:
            taken = clock.observe(stamp, walls.pop(frame.pts, None), report=reported, arrival=here())
            health.clock = clock.kind
        now = here()
        health.size, health.state, health.why, health.restarts = size, "live", "", clock.restarts
        health.last, health.pictures = now, health.pictures + 1
        if stamp is not None:
            if health.stamps and stamp <= health.stamps[-1]:
                health.stamps.clear()  # another connection
            health.stamps.append(stamp)
        if taken is not None:
            taken -= self.spec.delay_ms / 1000
            health.ways.append(now - taken)
            self._deliver(Stamped(self.number, taken, now, frame))
        return True


def _whole(packet: Any, gathering: Gathering | None) -> list[tuple[Any, bool, bool]]:
    """Pictures that are whole with a packet, each with whether a decoder can begin there, and whether it was cut."""
    if gathering is None:
        return [(packet, packet.is_keyframe and packet.size > 0, False)]
    out = []
    for one in gathering.push(bytes(packet), packet.pts):
        picture = av.Packet(one.data)
        picture.pts, picture.time_base = one.stamp, packet.time_base
        out.append((picture, one.key, one.cut))
    return out


def _decoded(decoder: Any, packet: Any) -> tuple[list[Any], bool]:
    """Return the sound frames of a picture, and whether something in it was not."""
    try:
        frames = decoder.decode(packet)
    except av.error.InvalidDataError:
        return [], True
    sound = [frame for frame in frames if not frame.is_corrupt]
    return sound, len(sound) < len(frames) or packet.is_corrupt
