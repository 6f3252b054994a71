"""A live drill: play a finished recording into a folder at a given rate, follow it with ``gsstream run``, and report.

Usage: python -m tools.drill --source demo --fps 7.5 --frames 60 --out DIR [--watch "behind=drop&queue=2"]
       [-- --method s2gs-edge --recipe recording:live --budget time=0.2 ...]

What follows ``--`` goes to ``gsstream run``. The recording runs there and back again for as many frames as are asked
for. The capture begins when the run waits for it. Writes DIR/capture (the growing recording), DIR/run (of gsstream run)
and DIR/drill.json. The last holds latency, the frames that each policy dropped or held, the quality of all later frames
with the dropped ones, and the load of the machine during the run, without which the seconds cannot be judged.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

from gsstream.core.errors import GsstreamError, InputError, OutputError
from gsstream.engine.run.live import latency_lines
from gsstream.engine.run.session import METRICS, RECIPE
from gsstream.evaluation.records import mean, read_lines
from gsstream.input.recordings.calibration import CALIBRATION_FILE, frame_path, read_calibration
from gsstream.input.recordings.open import DEMO_FOLDER
from gsstream.input.recordings.pointfiles import POINTS_FILE

WATCH = "behind=drop&ready=rename"
GSSTREAM = (sys.executable, "-c", "from gsstream.cli.main import main; main()")
_POLICIES = ("dropped", "missing", "hurried", "held")


def there_and_back(index: int, length: int) -> int:
    """Frame of a recording of ``length`` frames to show at ``index``: 0, 1, ..., length - 1, ..., 1, 0, 1, ..."""
    place = index % max(1, 2 * length - 2)
    return min(place, 2 * length - 2 - place) if length > 1 else 0


class Capture(threading.Thread):
    """Cameras that write: every image of a frame at its time, under another name first, then renamed; END at last."""

    def __init__(self, finished: Path, folder: Path, fps: float, frames: int) -> None:
        super().__init__(daemon=True)
        self._finished, self._folder, self._fps, self._frames = finished, folder, fps, frames
        calibration = read_calibration(finished)
        self._patterns, self._length = calibration.patterns, calibration.num_frames
        #: Largest delay of a frame after its due time, seconds; and what ended the capture early.
        self.late, self.failure = 0.0, ""
        self.stopped = threading.Event()
        folder.mkdir(parents=True)
        data = json.loads((finished / CALIBRATION_FILE).read_text(encoding="utf-8"))
        data.pop("frames", None)
        (folder / CALIBRATION_FILE).write_text(json.dumps({**data, "fps": fps}), encoding="utf-8")
        if (finished / POINTS_FILE).exists():
            shutil.copyfile(finished / POINTS_FILE, folder / POINTS_FILE)

    def run(self) -> None:
        """Write all frames, unless somebody sets ``stopped``."""
        try:
            began = time.monotonic()
            for index in range(self._frames):
                if self.stopped.wait(max(0.0, began + index / self._fps - time.monotonic())):
                    return
                for pattern in self._patterns.values():
                    self._put(pattern, index)
                self.late = max(self.late, time.monotonic() - began - index / self._fps)
            (self._folder / "END").touch()
        except OSError as error:
            self.failure = str(error)

    def _put(self, pattern: str, index: int) -> None:
        target = self._folder / frame_path(pattern, index)
        target.parent.mkdir(parents=True, exist_ok=True)
        # copyfile leaves the time of modification at now: latency is measured from it.
        part = target.with_name(f"{target.name}.part")
        shutil.copyfile(self._finished / frame_path(pattern, there_and_back(index, self._length)), part)
        part.replace(target)


def drill(finished: Path, out: Path, fps: float, frames: int, watch: str, options: Sequence[str]) -> dict[str, Any]:
    """Play a recording, follow it, and return what is reported.

    Raises OutputError when ``out`` exists, and GsstreamError when the run fails (its messages have been shown).
    """
    if out.exists():
        raise OutputError(f"{out} exists; expected a new folder, choose another --out")
    capture = Capture(finished, out / "capture", fps, frames)
    source = f"watch:{out / 'capture'}?{watch}"
    command = [*GSSTREAM, "run", "--source", source]
    machine, own, began = _busy(), _own(), time.monotonic()
    load = os.getloadavg()[0]
    try:
        with subprocess.Popen([*command, "--out", str(out / "run"), "--no-pictures", *options]) as process:
            while process.poll() is None and not (out / "run" / RECIPE).exists():
                time.sleep(0.02)
            capture.start()
            code = process.wait()
    finally:
        capture.stopped.set()
    if code or capture.failure:
        raise GsstreamError(f"the drill failed: gsstream run ended with {code}; capture: {capture.failure or 'sound'}")
    seconds, machine_now = time.monotonic() - began, _busy()
    used = _own() - own
    others = None if machine is None or machine_now is None else max(0.0, machine_now - machine - used) / seconds
    lines = read_lines(out / "run" / METRICS)
    return {
        "fps": fps,
        "watch": watch,
        "options": list(options),
        **reported(lines),
        **evaluated(out, len(lines)),
        "capture_late_s": capture.late,
        "machine": {
            "processors": os.cpu_count(),
            "load_before": load,
            "load_after": os.getloadavg()[0],
            "used_by_the_run": used / seconds,
            "used_by_others": others,
        },
        "said": latency_lines(lines),
    }


def reported(lines: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the numbers of a drill."""
    later = lines[1:]
    shown = [line for line in later if line["live"]["policy"] not in ("dropped", "missing")]
    latency = sorted(line["live"]["latency_seconds"] for line in shown)
    half = [line["live"]["latency_seconds"] for line in shown if line["frame"] >= len(lines) / 2]
    refining = [line["live"]["latency_seconds"] for line in shown if line.get("refine_iterations", 0) > 0]
    deltas = [sum(line["bytes"].values()) for line in later if line["status"] != "key"]
    numbers = {
        "latency_first_s": lines[0]["live"]["latency_seconds"],
        "latency_median_s": median(latency) if latency else math.nan,
        "latency_p90_s": latency[math.ceil(0.9 * len(latency)) - 1] if latency else math.nan,
        "latency_worst_s": latency[-1] if latency else math.nan,
        "latency_median_of_second_half_s": median(half) if half else math.nan,
        "latency_median_while_refining_s": median(refining) if refining else math.nan,
        "kb_per_frame": sum(deltas) / 1000 / len(deltas) if deltas else math.nan,
        "seconds_per_shown_frame": mean(sum(line["seconds"].values()) for line in shown),
        "cpu_seconds_per_shown_frame": mean(line["cpu_seconds"] for line in shown),
    }
    policies = {name: sum(line["live"]["policy"] == name for line in later) for name in _POLICIES}
    known = {name: None if math.isnan(value) else value for name, value in numbers.items()}
    return {"frames": len(lines), **policies, "keys_later": sum(line["status"] == "key" for line in later), **known}


def evaluated(out: Path, frames: int) -> dict[str, float | None]:
    """Return the means of ``gsstream evaluate`` over all frames but the first, dropped ones too."""
    path = out / "capture" / CALIBRATION_FILE
    data = json.loads(path.read_text(encoding="utf-8"))
    path.write_text(json.dumps({**data, "frames": frames}), encoding="utf-8")
    command = [*GSSTREAM, "evaluate", str(out / "run"), "--source", str(out / "capture"), "--json"]
    views = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)["views"]
    later = [view for view in views if view["frame"] > 0]
    names = ("psnr", "psnr_moving", "psnr_changed", "static_psnr", "static_psnr_changed")
    found = {name: mean(view[name] for view in later if view[name] is not None) for name in names}
    return {name: None if math.isnan(value) else value for name, value in found.items()}


def _own() -> float:
    """Processor seconds of this process and of its children that have ended."""
    return sum(
        usage.ru_utime + usage.ru_stime
        for usage in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )


def _busy() -> float | None:
    """Processor seconds that the machine has worked since it started; None where the system does not count them."""
    try:
        fields = Path("/proc/stat").read_text(encoding="ascii").splitlines()[0].split()[1:]
    except OSError:
        return None
    user, nice, system = map(int, fields[:3])
    return (user + nice + system) / os.sysconf("SC_CLK_TCK")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run as a command; returns the exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    place = given.index("--") if "--" in given else len(given)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", default="demo", help="demo, or a folder with cameras.json")
    parser.add_argument("--fps", type=float, default=7.5)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--watch", default=WATCH, help=f"options of the source (default {WATCH})")
    wanted = parser.parse_args(given[:place])
    if wanted.fps <= 0 or wanted.frames < 1:
        raise InputError(f"expected --fps above 0 and --frames of at least 1, got {wanted.fps:g} and {wanted.frames}")
    finished = DEMO_FOLDER if wanted.source == "demo" else Path(wanted.source)
    found = drill(
        finished, wanted.out, wanted.fps, frames=wanted.frames, watch=wanted.watch, options=given[place + 1 :]
    )
    text = json.dumps(found, indent=1)
    (wanted.out / "drill.json").write_text(text + "\n", encoding="utf-8")
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
