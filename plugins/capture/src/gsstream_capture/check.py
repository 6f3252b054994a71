"""``gsstream capture --check``: ten seconds of all cameras, and whether an hour of them would be worth its time."""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.errors import SourceError
from gsstream.input.prepare.findings import Finding
from gsstream.input.prepare.picture_checks import Thumbnails
from gsstream.input.prepare.sync_checks import check_sync
from gsstream_capture.capture import CLOCKS, LiveRig, Say, calibration_of, plans_of
from gsstream_capture.exposure import gains, percents
from gsstream_capture.folder import claim
from gsstream_capture.pairing import Offset
from gsstream_capture.pictures import CameraPlan, jpeg, pixels_of
from gsstream_capture.reader import CameraReader
from gsstream_capture.rig import Rig

#: Width of the pictures whose motion is compared, pixels; share by which exposures may differ; seconds between key
#: pictures that are too long: a damaged picture costs all until the next one.
SMALL, EXPOSURE, KEYS = 160, 0.03, 2.5


@dataclass
class _Seen:
    instants: int = 0
    whole: int = 0
    bytes: int = 0
    first: list[Any] = field(default_factory=list)
    small: list[Any] = field(default_factory=list)


def check(rig: Rig, folder: Path, out: Path, *, seconds: float, say: Say) -> None:
    """Look at all cameras for so long, save a picture of each in ``out``, and say what is found.

    Raises SourceError where a camera sends nothing, or pictures contradict the clocks by a frame.
    """
    calibration, path = (None, out) if rig.calibration is None else calibration_of(rig)
    claim(out)
    with LiveRig(rig, folder) as live:
        say(f"waiting for {len(rig.cameras)} cameras")
        instant = live.first()
        plans = plans_of(live, calibration, path)
        seen, began, used = _Seen(), time.monotonic(), time.process_time()
        while time.monotonic() - began < seconds:
            if instant is not None:
                seen.instants += 1
                if not instant.absent:
                    _take(seen, [instant.pictures[n].frame for n in range(len(plans))], plans, rig.quality)
            instant = live.next(0.2)  # type: ignore[assignment]
        passed, worked = time.monotonic() - began, time.process_time() - used
        offsets = live.pairing.offsets()
    for plan, picture in zip(plans, seen.first, strict=True):
        (out / f"{plan.name}.jpg").write_bytes(jpeg(picture, rig.quality))
    lines = _table(live.readers, offsets)
    lines += [f"{seen.whole} of {seen.instants} instants have pictures of all cameras"]
    lines += _room(seen, passed, worked, out)
    found: list[Finding] = []
    if calibration is not None and len(seen.small) > 1:
        lines += _exposure(gains(seen.first, plans), plans)
        found = check_sync(_thumbnails(seen, plans))
        lines += [f"pictures and clocks: {one.message}" for one in found] or ["pictures and clocks agree"]
    say("\n".join([*lines, f"wrote a picture of each camera to {out}"]))
    if wrong := [one.message for one in found if one.severity == "error"]:
        raise SourceError(f"the pictures contradict the clocks: {wrong[0]}")


def _take(seen: _Seen, frames: list[Any], plans: list[CameraPlan], quality: int) -> None:
    pictures = [plan.apply(pixels_of(frame, plan.rotate)) for frame, plan in zip(frames, plans, strict=True)]
    seen.whole += 1
    if not seen.first:
        seen.first = pictures
        seen.bytes = sum(len(jpeg(picture, quality)) for picture in pictures)
    sizes = [(SMALL, max(1, round(SMALL * p.shape[0] / p.shape[1]))) for p in pictures]
    seen.small.append([cv2.resize(p, s, interpolation=cv2.INTER_AREA) for p, s in zip(pictures, sizes, strict=True)])


def _thumbnails(seen: _Seen, plans: list[CameraPlan]) -> Thumbnails:
    images = np.array(seen.small)[..., ::-1].astype(np.float32) / np.float32(255)
    width, height = plans[0].size
    names = tuple(plan.name for plan in plans)
    rig = Cameras(names, np.stack([p.w2c for p in plans]), np.stack([p.K for p in plans]), width, height)
    return Thumbnails(images, rig, len(plans))


def _table(readers: list[CameraReader], offsets: Any) -> list[str]:
    lines = []
    for reader in readers:
        health, size = reader.health, reader.health.size or (0, 0)
        off: Offset | None = offsets.get(reader.number)
        line = f"{reader.spec.id}: {size[0]} x {size[1]}, {health.fps:.1f}/s, paired by {CLOCKS[health.clock]}"
        if off is not None:
            line += f", {1000 * off.median:+.1f} ms from the rig (spread {1000 * off.spread:.1f})"
        if health.ways:
            line += f", {1000 * median(health.ways):.0f} ms on its way"
        keys = np.diff(health.keys)
        if len(keys) and (gap := float(np.median(keys))) > KEYS:
            line += f"; sends a key picture every {gap:.1f} s: set its GOP to 1 s"
        if health.damaged:
            line += f"; {health.damaged} pictures were damaged"
        lines.append(line)
    return lines


def _room(seen: _Seen, passed: float, worked: float, out: Path) -> list[str]:
    rate = seen.bytes * seen.instants / passed
    hours = shutil.disk_usage(out).free / rate / 3600 if rate else float("inf")
    return [f"disk: {rate / 1e6:.1f} MB/s, full in {hours:.1f} hours; processor: {worked / passed:.2f} cores"]


def _exposure(found: Any, plans: list[CameraPlan]) -> list[str]:
    lines = []
    for plan, gain in zip(plans, found, strict=True):
        if np.isnan(gain).any():
            lines.append(f"exposure of {plan.name}: not known (too few points that others see, too)")
        elif np.abs(gain - 1).max() > EXPOSURE:
            lines.append(f"exposure of {plan.name}: {percents(gain)}; set exposure and white balance to manual")
    return lines or ["exposures agree within 3 %"]
