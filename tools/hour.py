"""An hour of live cameras that die and come back, encoded while they send: what is lost, and what grows.

Usage: python -m tools.hour --minutes 60 --out OUT [--source demo] [--cameras 5] [--rate 5] [--fps 2]
       [-- --set stream.refine_iterations=90 ...]

A recording is served as RTSP cameras on loopback, as by ``python -m tools.rehearsal``; they send ``--rate`` pictures a
second. One command, ``gsstream run --source rig:...``, captures ``--fps`` instants a second and encodes them; what
follows ``--`` goes to it. About once a minute a camera is killed for 5 to 40 s, stopped for as long and continued, or
sends garbage (drawn from ``--seed``). At the end all cameras are killed, so the capture ends as its page says.

Writes OUT/samples.jsonl (a line every ten seconds: memory, descriptors and threads of both processes, files of the run,
instants captured, frames encoded), OUT/faults.jsonl, and OUT/hour.json. In the last every instant is accounted for:
captured ones by their files and their line of ``capture.jsonl``, the others by gaps between the lines' times; frames by
their line of ``metrics.jsonl`` and by decoding the stream from its first packet to its last.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gsstream.core.errors import GsstreamError, InputError
from gsstream.encode import open_recording
from gsstream.engine.run.session import METRICS, STREAM
from gsstream.evaluation.records import read_lines
from gsstream.player.playback import Playback
from tools.drill import GSSTREAM
from tools.rehearsal import prepared, recording_of, reported, resident_mb, restarted

#: Seconds between two samples; between two faults, drawn; and that the run gets to end after its cameras are gone.
SAMPLE, BETWEEN, ENDING = 10.0, (30.0, 90.0), 180.0
#: Seconds at the beginning and at the end in which nothing is done to the cameras.
PEACE = 60.0


def hour(finished: str, out: Path, given: argparse.Namespace, options: Sequence[str]) -> dict[str, Any]:
    """Serve, capture, encode and account for it. Raises InputError where ``out`` is not new, GsstreamError for a run
    that fails."""
    with open_recording(finished) as source:
        names = [*source.info.train.ids[: given.cameras - 1], *source.info.test.ids[:1]]
        units, epoch, servers, rig = prepared(source, out, names, rate=given.rate, fps=given.fps)
    command = [*GSSTREAM, "run", "--source", f"rig:{rig}?folder={out / 'capture'}", "--no-pictures"]
    command += ["--method", "s2gs-edge", "--recipe", "recording:live", "--out", str(out / "run"), *options]
    over = threading.Event()
    with (out / "run.log").open("w") as log, subprocess.Popen(command, stdout=log, stderr=log) as process:
        try:
            _wait_for(out / "run" / METRICS, process)
            began = time.monotonic()
            faults = _Faults(servers, units, epoch, out / "faults.jsonl", given=given, over=over)
            faults.start()
            _sample_until(began + 60 * given.minutes, process, out)
            over.set()
            faults.join()
            for server in servers.values():
                server.stop()
            _sample_until(time.monotonic() + ENDING, process, out)
        finally:
            over.set()
            for server in servers.values():
                server.stop()
            process.send_signal(signal.SIGINT)
            code = process.wait()
    if code:
        raise GsstreamError(f"the run ended with {code}; see {out / 'run.log'}")
    return accounted(out, names, given.fps)


def _wait_for(path: Path, process: subprocess.Popen[Any]) -> None:
    while not (path.exists() and path.stat().st_size):
        if process.poll() is not None:
            raise GsstreamError(f"the run ended with {process.returncode} before its first frame")
        time.sleep(0.5)


def _sample_until(end: float, process: subprocess.Popen[Any], out: Path) -> None:
    """Write a line every ten seconds while the run lives."""
    captured, encoded = _Lines(out / "capture" / "capture.jsonl"), _Lines(out / "run" / METRICS)
    with (out / "samples.jsonl").open("a", encoding="utf-8") as file:
        while time.monotonic() < end and process.poll() is None:
            line = {
                "time": round(time.time(), 1),
                "run": facts_of(process.pid),
                "capture": next(map(facts_of, _children(process.pid)), None),
                "files_of_the_run": len(list((out / "run").iterdir())),
                "instants": captured.count(),
                "frames": encoded.count(),
                "bytes": (out / "run" / STREAM).stat().st_size,
                "load": os.getloadavg()[0],
            }
            file.write(json.dumps(line) + "\n")
            file.flush()
            time.sleep(SAMPLE)


class _Lines:
    """How many lines a growing file has; each look reads what came since the one before."""

    def __init__(self, path: Path) -> None:
        self._path, self._at, self._lines = path, 0, 0

    def count(self) -> int:
        with self._path.open("rb") as file:
            file.seek(self._at)
            data = file.read()
        self._at, self._lines = self._at + len(data), self._lines + data.count(b"\n")
        return self._lines


def facts_of(process: int) -> dict[str, float] | None:
    """Return memory in MB, descriptors, threads and processor seconds of a process; None when it is gone (Linux)."""
    place = Path(f"/proc/{process}")
    try:
        fields = (place / "stat").read_text(encoding="ascii").rpartition(")")[2].split()
        ticks = int(fields[11]) + int(fields[12])
        descriptors, threads = len(list((place / "fd").iterdir())), len(list((place / "task").iterdir()))
    except OSError:
        return None
    seconds = round(ticks / os.sysconf("SC_CLK_TCK"), 1)
    return {"mb": resident_mb(process), "descriptors": descriptors, "threads": threads, "cpu_s": seconds}


def _children(process: int) -> list[int]:
    """Processes that capture, of a run."""
    found = []
    for task in Path(f"/proc/{process}/task").glob("*/children"):
        try:
            found += [int(child) for child in task.read_text(encoding="ascii").split()]
        except OSError:
            continue
    return sorted(found)


class _Faults(threading.Thread):
    """What happens to the cameras: a line of a file for each beginning and end."""

    def __init__(
        self,
        servers: dict[str, Any],
        units: Mapping[str, Path],
        epoch: float,
        log: Path,
        *,
        given: argparse.Namespace,
        over: threading.Event,
    ) -> None:
        super().__init__(daemon=True)
        self._servers, self._units, self._epoch, self._log = servers, units, epoch, log
        self._given, self._over = given, over
        self._end = time.monotonic() + 60 * given.minutes - PEACE

    def run(self) -> None:
        """One fault after the other, until it is over."""
        draw = random.Random(self._given.seed)
        self._over.wait(PEACE)
        with self._log.open("a", encoding="utf-8") as file:
            while time.monotonic() < self._end and not self._over.is_set():
                name, kind = draw.choice(sorted(self._servers)), draw.choice(("killed", "stopped", "garbage"))
                seconds, rest = draw.uniform(5, 40), draw.uniform(*BETWEEN)
                file.write(json.dumps({"time": time.time(), "camera": name, "what": kind, "seconds": seconds}) + "\n")
                file.flush()
                self._do(kind, name, seconds)
                self._over.wait(rest)

    def _do(self, kind: str, name: str, seconds: float) -> None:
        server = self._servers[name]
        if kind == "garbage":
            server.say(f"garbage {name} {round(seconds * self._given.rate / 4)}")
        elif kind == "stopped":
            server.send(signal.SIGSTOP)
            self._over.wait(seconds)
            server.send(signal.SIGCONT)
        else:
            server.stop()
            self._over.wait(seconds)
            self._servers[name] = restarted(server, name, self._units[name], self._given.rate, epoch=self._epoch)


def accounted(out: Path, names: Sequence[str], fps: float) -> dict[str, Any]:
    """Return what became of every instant from the first to the last; one without a word is a GsstreamError."""
    told = _records(out / "capture" / "capture.jsonl")
    lines = read_lines(out / "run" / METRICS)
    times = [line["time"] for line in told]
    # Instants follow one another by the clock of the cameras, within 5 % of the rig's rate.
    gaps = [round((b - a) * fps) - 1 for a, b in itertools.pairwise(times)]
    decoded, kinds = _decoded(out / "run" / STREAM)
    frames = [line["frame"] for line in lines]
    if not frames == decoded == list(range(len(told))):
        raise GsstreamError(f"{len(told)} instants captured, {len(frames)} lines, {len(decoded)} frames decoded")
    policies = Counter(line["live"]["policy"] or "encoded in turn" for line in lines)
    absent = Counter(name for line in told for name in line["absent"])
    pictures = reported(out / "capture", names)
    return {
        "instants_by_the_clock": len(told) + sum(gaps),
        "captured": len(told),
        "of_all_cameras": sum(not line["absent"] for line in told),
        "dropped_by_the_capture": told[-1]["dropped"],
        "without_any_camera": sum(gaps) - told[-1]["dropped"],
        "pictures_absent": sum(absent.values()),
        "absent": dict(absent),
        "files_that_lines_name": _named_files(out / "capture", told, names),
        "mixed_instants": pictures["mixed"],
        "lines": len(lines),
        "frames_decoded": len(decoded),
        "packets": kinds,
        "policies": dict(policies),
        "faults": dict(Counter(fault["what"] for fault in _records(out / "faults.jsonl"))),
        **grown(_records(out / "samples.jsonl")),
    }


def _records(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def _decoded(stream: Path) -> tuple[list[int], dict[str, int]]:
    with Playback(stream) as playback:
        found = []
        for frame in playback.frames:
            playback.player_state(frame)
            found.append(frame)
        return found, dict(Counter(playback.entry(frame).kind.name.lower() for frame in found))


def _named_files(folder: Path, told: Sequence[dict[str, Any]], names: Sequence[str]) -> str:
    """Compare the pictures that are there with those that the log names."""
    for name in names:
        there = {int(path.stem) for path in (folder / name).glob("*.jpg")}
        if there != {line["frame"] for line in told if name not in line["absent"]}:
            raise GsstreamError(f"{folder / name}: the pictures are not those that capture.jsonl names")
    return "all"


def grown(samples: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return memory and descriptors of both processes at the beginning, in the middle and at the end, and the most."""
    full = [sample for sample in samples if sample["run"] and sample["capture"]]
    # The first fifth holds the first frame and its refinement.
    at = [full[int(share * (len(full) - 1))] for share in (0.2, 0.4, 0.6, 0.8, 1.0)]
    out: dict[str, Any] = {}
    for process in ("run", "capture"):
        for key in ("mb", "descriptors", "threads"):
            out[f"{process}_{key}"] = [sample[process][key] for sample in at]
            out[f"{process}_most_{key}"] = max(sample[process][key] for sample in full)
    return out | {"files_of_the_run": [sample["files_of_the_run"] for sample in at]}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run as a command; returns the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    place = words.index("--") if "--" in words else len(words)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", default="demo", help="demo, or a folder with cameras.json")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--cameras", type=int, default=5, help="how many, the last of them a test camera")
    parser.add_argument("--rate", type=int, default=5, help="pictures a second that each camera sends")
    parser.add_argument("--fps", type=float, default=2.0, help="instants a second that are captured")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args(words[:place])
    if not 3 <= given.cameras <= 64 or given.minutes <= 0 or not 0 < given.fps <= given.rate:
        raise InputError("expected 3 to 64 cameras, --minutes above 0, and --fps above 0 and at most --rate")
    found = hour(recording_of(given.source), given.out, given, words[place + 1 :])
    text = json.dumps(found, indent=1)
    (given.out / "hour.json").write_text(text + "\n", encoding="utf-8")
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
