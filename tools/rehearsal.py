"""A rehearsal of live cameras: a recording as RTSP cameras on loopback, captured, and told what came of it.

Usage: python -m tools.rehearsal --source DIR --fps 10 --seconds 60 --late 30 --out OUT

Pictures are encoded ahead as H.264 with their number painted in, and sent by one process of GStreamer's server for each
camera (apt install gir1.2-gst-rtsp-server-1.0 python3-gst-1.0 gstreamer1.0-plugins-good gstreamer1.0-plugins-bad), with
a few milliseconds of jitter. The second camera is ``--late`` milliseconds late, and with ``--unplug SECONDS`` the third
one is killed after a third of the time and comes back so much later. With ``--rate`` cameras send more pictures than
``--fps`` instants a second, and with ``--lose`` each of them loses a share of its pictures on the way.

With ``--browser`` it is the whole way instead: ``gsstream capture --check``, then ``gsstream run --source rig:...
--serve``, and a headless Chromium whose picture is compared with that of the test camera (OUT/browser.png).

Writes OUT/capture and OUT/rehearsal.json: instants that are whole and of one number, offsets, delays, memory of the
process that captures, and the load of the machine.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from gsstream.core.errors import InputError
from gsstream.encode import Source, open_recording
from gsstream.input.recordings.calibration import CALIBRATION_FILE
from gsstream.input.recordings.open import DEMO_FOLDER
from tools.drill import there_and_back
from tools.rehearsal_page import checked, shown
from tools.sampling import resident_mb

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "plugins" / "capture" / "tests"))
#: Pictures of a camera, which then begin again; milliseconds of jitter.
LENGTH, JITTER = 400, 8


def recording_of(text: str) -> str:
    """Return the folder of a recording that a command names."""
    return str(DEMO_FOLDER) if text == "demo" else text


def prepared(
    source: Source, out: Path, names: Sequence[str], *, rate: float, fps: float, paint: bool = True
) -> tuple[dict[str, Path], float, dict[str, Any], Path]:
    """Encode cameras of a recording ahead, serve them from now on, and write a rig file.

    ``paint``: their number into the upper edge. Returns encoded pictures by camera, when their picture 0 was, the
    servers, and the rig file. Raises InputError where ``out`` is not new.
    """
    from live_rig import Server, encoded, painted, rig_file

    if out.exists():
        raise InputError(f"{out} exists; expected a new folder, choose another --out")
    out.mkdir(parents=True)
    shutil.copyfile(Path(source.info.uri) / CALIBRATION_FILE, out / CALIBRATION_FILE)

    def pictures(name: str) -> Iterator[Any]:
        length = source.info.num_frames or 1
        for index in range(LENGTH):
            image = source.image(there_and_back(index, length), name)
            pixels = np.round(255 * image).astype(np.uint8)
            yield painted(pixels, index) if paint else pixels

    units = {name: encoded(out / name, pictures(name), round(rate)) for name in names}
    epoch = time.time()
    servers = {name: Server({name: units[name]}, rate, epoch) for name in names}
    for name, server in servers.items():
        server.say(f"jitter {name} {JITTER}")
    return units, epoch, servers, rig_file(out, {name: server.url(name) for name, server in servers.items()}, fps)


def rehearse(finished: str, out: Path, given: argparse.Namespace) -> dict[str, Any]:
    """Serve a recording, capture it, and return what is reported. Raises InputError where ``out`` is not new."""
    from live_rig import Capturing

    with open_recording(finished) as source:
        tests = list(source.info.test.ids[: bool(given.browser)])
        names = [*source.info.train.ids[: given.cameras - len(tests)], *tests]
        rate, size = given.rate or given.fps, (source.info.train.width, source.info.train.height)
        units, epoch, servers, rig = prepared(source, out, names, rate=rate, fps=given.fps, paint=not given.browser)
    servers[names[1]].say(f"delay {names[1]} {given.late}")
    for name in names if given.lose else ():
        servers[name].say(f"lose {name} {given.lose}")
    if given.browser:
        try:
            return {"check": checked(rig, out), **shown(rig, out, size, names[-1])}
        finally:
            for server in servers.values():
                server.stop()
    memory: list[int] = []
    try:
        capture = Capturing(rig, out / "capture", "--seconds", str(given.seconds))
        capture.wait_for("paired by", 90)
        if given.unplug:
            lost = (servers, names[2], units[names[2]], epoch)
            threading.Thread(target=_unplug, args=(*lost, given), daemon=True).start()
        while capture.process.poll() is None:
            memory.append(resident_mb(capture.process.pid))
            time.sleep(1.0)
        code = capture.end()
    finally:
        for server in servers.values():
            server.stop()
    numbers = reported(out / "capture", names)
    return {"code": code, "said": capture.lines, **numbers, "memory_mb": memory[:: 1 + len(memory) // 20]}


def _unplug(servers: dict[str, Any], name: str, units: Path, epoch: float, given: argparse.Namespace) -> None:
    time.sleep(given.seconds / 3)
    servers[name].stop()
    time.sleep(given.unplug)
    servers[name] = restarted(servers[name], name, units, given.rate or given.fps, epoch=epoch)


def restarted(server: Any, name: str, units: Path, rate: float, *, epoch: float) -> Any:
    """Return a camera that is back at the address of one that was stopped."""
    from live_rig import Server

    return Server({name: units}, rate, epoch, port=server.port)


def reported(folder: Path, names: Sequence[str]) -> dict[str, Any]:
    """Return the numbers of a capture whose pictures carry their number."""
    from live_rig import captured

    numbers = captured(folder)
    lines = [json.loads(line) for line in (folder / "capture.jsonl").read_text(encoding="utf-8").splitlines()]
    one = [len(set(row.values())) == 1 for row in numbers]
    offsets = {name: [line["offset_ms"][name] for line in lines if name in line["offset_ms"]] for name in names}
    return {
        "instants": len(numbers),
        "whole_and_right": sum(right and len(row) == len(names) for right, row in zip(one, numbers, strict=True)),
        "mixed": len(one) - sum(one),
        "absent": {name: sum(name not in row for row in numbers) for name in names},
        "offset_ms": {name: median(values) for name, values in offsets.items() if values},
        # The least is what the way takes where the machine is not busy.
        "way_ms": {name: _way(lines, name) for name in names},
        "to_file_ms": median(line["written_ms"] for line in lines),
        "load": os.getloadavg()[0],
    }


def _way(lines: Sequence[dict[str, Any]], name: str) -> dict[str, float]:
    """Milliseconds from a picture to its arrival: the 5 % that were fastest, and the median."""
    ways = sorted(line["arrival_ms"][name] - line["offset_ms"][name] for line in lines if name in line["arrival_ms"])
    return {"fast": round(ways[len(ways) // 20], 1), "median": round(median(ways), 1)} if ways else {}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run as a command; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", default="demo", help="demo, or a folder with cameras.json")
    parser.add_argument("--cameras", type=int, default=4)
    parser.add_argument("--fps", type=float, default=10.0)
    parser.add_argument("--rate", type=float, default=0.0, help="pictures a second of each camera (0: as --fps)")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--late", type=float, default=30.0, help="milliseconds that the second camera is late")
    parser.add_argument("--unplug", type=float, default=0.0, help="seconds that the third camera is gone")
    parser.add_argument("--lose", type=float, default=0.0, help="share of the pictures that is lost on the way")
    parser.add_argument("--browser", action="store_true", help="the whole way, to a picture in a browser")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args(arguments)
    if not 3 <= given.cameras <= 64 or given.fps <= 0 or given.seconds <= 0:
        raise InputError("expected 3 to 64 cameras, and --fps and --seconds above 0")
    text = json.dumps(rehearse(recording_of(given.source), given.out, given), indent=1)
    (given.out / "rehearsal.json").write_text(text + "\n", encoding="utf-8")
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
