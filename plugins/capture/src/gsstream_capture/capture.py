"""Cameras -> pairing -> folder: the loop of a capture, in the thread that calls it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gsstream.core.errors import InputError, SourceError, suggest
from gsstream.input.recordings.calibration import CALIBRATION_FILE, Calibration, read_calibration
from gsstream_capture.clock import here
from gsstream_capture.exposure import matched
from gsstream_capture.folder import FULL, LOW, FolderWriter
from gsstream_capture.pairing import Instant, Pairing, Stamped
from gsstream_capture.pictures import CameraPlan, jpeg, pixels_of, planned, upright_size
from gsstream_capture.reader import CameraReader
from gsstream_capture.report import Report
from gsstream_capture.rig import Rig, opening_of, shown

#: Seconds that the first whole instant may take; seconds without any picture after which a capture ends.
BEGIN, TIMEOUT = 90.0, 30.0
#: Seconds between two looks while nothing comes.
LOOK = 0.1
Say = Callable[[str], None]
OnPicture = Callable[[int, Any], None]


class LiveRig:
    """Cameras that are read and paired. Close it; it is a context manager."""

    def __init__(self, rig: Rig, folder: Path, *, depth: int = 32) -> None:
        self.rig = rig
        self.pairing = Pairing(len(rig.cameras), rig.fps, depth=depth)
        self._lock, self._came = threading.Lock(), threading.Event()
        began = here() + 0.5
        self.readers = [
            CameraReader(
                number,
                spec,
                opening_of(spec, folder, f"cameras[{number}].url"),
                self._deliver,
                step=0.5 / rig.fps,
                by_clock=rig.clock == "capture",
                began=began,
            )
            for number, spec in enumerate(rig.cameras)
        ]

    def __enter__(self) -> LiveRig:
        for reader in self.readers:
            reader.start()
        return self

    def __exit__(self, *_: object) -> None:
        for reader in self.readers:
            reader.stop()
        for reader in self.readers:
            reader.join(1.0)

    def _deliver(self, picture: Stamped) -> None:
        with self._lock:
            self.pairing.push(picture)
        self._came.set()

    def next(self, seconds: float) -> Instant | None:
        """Wait at most so long for a complete instant."""
        end = time.monotonic() + seconds
        while True:
            self._came.clear()
            with self._lock:
                instant = self.pairing.poll(here())
            left = end - time.monotonic()
            if instant is not None or left <= 0:
                return instant
            self._came.wait(min(left, LOOK))

    def first(self, seconds: float = BEGIN) -> Instant:
        """Wait for the first instant, which needs all cameras. Raises SourceError naming those that lack, and why."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            instant = self.next(0.5)
            if instant is not None and not instant.absent:
                return instant
            if all(reader.health.state == "ended" for reader in self.readers):
                break
        lacking = [f"{r.spec.id!r} ({shown(r.spec.url)}): {_state(r)}" for r in self.readers if _lacks(r)]
        reason = "; ".join(lacking) or "all send, but never within half a frame of each other for two seconds"
        raise SourceError(f"no first instant of all cameras within {seconds:.0f} s; {reason}")

    @property
    def heard(self) -> float:
        """When the last picture of any camera came."""
        return max(reader.health.last for reader in self.readers)


def _lacks(reader: CameraReader) -> bool:
    return reader.health.state != "live" or reader.health.clock is None


def _state(reader: CameraReader) -> str:
    health = reader.health
    if health.state == "live":
        return "its clock is not known yet: fewer than two RTCP reports came"
    return health.why or f"no picture yet ({health.state})"


def calibration_of(rig: Rig) -> tuple[Calibration, Path]:
    """Return the calibration of a rig's cameras and its file. Raises SourceError where there is none, or one lacks."""
    if rig.calibration is None:
        raise SourceError("the rig file has no 'calibration'; calibrate first: gsstream calibrate board")
    path = rig.calibration / CALIBRATION_FILE if rig.calibration.is_dir() else rig.calibration
    if path.name != CALIBRATION_FILE:
        raise SourceError(f"{path}: expected a file of the name {CALIBRATION_FILE}, or its folder")
    calibration = read_calibration(path.parent, growing=True, any_sizes=True)
    for camera in rig.cameras:
        if camera.id not in calibration.sizes:
            raise SourceError(f"{path}: has no camera {camera.id!r}{suggest(camera.id, calibration.sizes)}")
    return calibration, path


def plans_of(live: LiveRig, calibration: Calibration | None, path: Path) -> list[CameraPlan]:
    """Return what is done to the pictures of cameras of which all have sent one; without a calibration, turning."""
    sizes = [reader.health.size for reader in live.readers]
    assert all(sizes), "the first instant has pictures of all"
    specs = live.rig.cameras
    if calibration is None:
        upright = [upright_size(size or (0, 0), spec.rotate) for size, spec in zip(sizes, specs, strict=True)]
        known = np.eye(3), np.eye(4)
        return [CameraPlan(c.id, *known, size, "train", c.rotate) for c, size in zip(specs, upright, strict=True)]
    return planned(
        [spec.id for spec in specs],
        [spec.rotate for spec in specs],
        calibration,
        [size for size in sizes if size],
        where=str(path),
    )


def run_capture(
    rig: Rig,
    folder: Path,
    out: Path,
    *,
    seconds: float | None,
    say: Say,
    stopped: threading.Event,
    raw: bool = False,
    look: OnPicture | None = None,
) -> Report:
    """Capture until ``seconds`` have passed, ``stopped`` is set, or all cameras are silent; END is written then.

    Arguments:
        folder: that paths in the rig file are relative to.
        say: takes one line when a camera goes or comes back.
        raw: write pictures as they come, turned but not straightened, without a calibration.
        look: is shown every picture that is written: the camera's number, and its pixels, blue first.

    Raises:
        SourceError: no calibration, or a camera sends nothing from the start; the message names it and why.
        OutputError: the folder holds something, or cannot be written.
    """
    calibration, path = (None, out) if raw else calibration_of(rig)
    if out.exists() and any(out.iterdir()):
        raise InputError(f"{out} is not empty; expected a new folder, choose another --out")
    with LiveRig(rig, folder) as live:
        say(f"waiting for {len(rig.cameras)} cameras")
        instant = live.first()
        plans = plans_of(live, calibration, path)
        if rig.exposure == "match" and calibration is not None:
            first = [instant.pictures[number].frame for number in range(len(plans))]
            seen = [plan.apply(pixels_of(frame, plan.rotate)) for frame, plan in zip(first, plans, strict=True)]
            plans = matched(seen, plans, say)
        more = None if calibration is None else {"name": calibration.name, "licence": calibration.licence}
        writer = FolderWriter(out, plans, rig.fps, more=more)
        say("; ".join(f"{r.spec.id}: {_described(r)}" for r in live.readers))
        report = Report(absent=dict.fromkeys((spec.id for spec in rig.cameras), 0))
        try:
            _loop(live, writer, plans, report, _Until(seconds, stopped, look), say=say, instant=instant)
        finally:
            writer.end()
            report.frames, report.dropped = writer.frames, live.pairing.counts.dropped
    return report


def _described(reader: CameraReader) -> str:
    health = reader.health
    size = health.size or (0, 0)
    return f"{size[0]} x {size[1]}, {health.fps:.1f}/s, paired by {CLOCKS[health.clock]}"


CLOCKS = {
    "sender": "its own clock",
    "steadied": "its own clock, shifted to this machine's",
    "arrival": "arrival",
    None: "nothing yet",
}


@dataclass
class _Until:
    seconds: float | None
    stopped: threading.Event
    look: OnPicture | None = None
    began: float = field(default_factory=time.monotonic)

    def over(self) -> bool:
        return self.stopped.is_set() or (self.seconds is not None and time.monotonic() - self.began >= self.seconds)


def _loop(
    live: LiveRig,
    writer: FolderWriter,
    plans: list[CameraPlan],
    report: Report,
    until: _Until,
    *,
    say: Say,
    instant: Instant | None,
) -> None:
    """Write instants until it is over; ``instant``: the first, which is there."""
    states = {reader.number: reader.health.state for reader in live.readers}
    while True:
        if instant is not None and not _write(live, writer, plans, report, instant=instant, look=until.look):
            report.ended = "the disk is full"
        _tell_changes(live, states, say)
        if all(reader.health.state == "ended" for reader in live.readers) and instant is None:
            return
        if here() - live.heard > TIMEOUT:
            report.ended = f"no camera has sent a picture for {TIMEOUT:.0f} s"
        if report.ended or until.over():
            return
        instant = live.next(LOOK)


def _write(
    live: LiveRig,
    writer: FolderWriter,
    plans: list[CameraPlan],
    report: Report,
    *,
    instant: Instant,
    look: OnPicture | None,
) -> bool:
    """Write one instant, or count it where the disk is nearly full; False: there is no room for anything."""
    free = writer.free if writer.frames % 10 == 0 or report.disk else LOW
    if free < LOW:
        report.disk += 1
        return free >= FULL
    files = {}
    for number, picture in instant.pictures.items():
        pixels = plans[number].apply(pixels_of(picture.frame, plans[number].rotate))
        files[number] = jpeg(pixels, live.rig.quality)
        if look is not None:
            look(number, pixels)
    writer.add(files, _line(live, instant))
    report.whole += not instant.absent
    for number in instant.absent:
        report.absent[plans[number].name] += 1
    report.delays.append(here() - instant.time)
    del report.delays[:-10_000]
    return True


def _line(live: LiveRig, instant: Instant) -> dict[str, Any]:
    names = [spec.id for spec in live.rig.cameras]
    pictures: Mapping[int, Stamped] = instant.pictures
    return {
        "time": round(instant.time, 4),
        "spread_ms": round(1000 * instant.spread, 2),
        "absent": [names[number] for number in instant.absent],
        "offset_ms": {names[n]: round(1000 * (p.time - instant.time), 2) for n, p in pictures.items()},
        "arrival_ms": {names[n]: round(1000 * (p.arrival - instant.time), 1) for n, p in pictures.items()},
        "written_ms": round(1000 * (here() - instant.time), 1),
        "dropped": live.pairing.counts.dropped,
    }


def _tell_changes(live: LiveRig, states: dict[int, Any], say: Say) -> None:
    """One line when a camera goes, one when it is back."""
    for reader in live.readers:
        state, name = reader.health.state, reader.spec.id
        gone = "silent" if reader.health.state == "live" and here() - reader.health.last > TIMEOUT else state
        if gone == states[reader.number] or gone == "opening" or (gone == "live" and reader.health.clock is None):
            continue
        if gone == "live":
            say(f"{name} is back; {_described(reader)}")
        else:
            say(f"{name} is {'refused' if gone == 'refused' else 'gone'}: {reader.health.why or 'its file has ended'}")
        states[reader.number] = gone
