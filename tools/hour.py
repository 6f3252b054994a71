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
from tools.drill import GSSTREAM
from tools.rehearsal import prepared, recording_of, reported, restarted
from tools.sampling import Lines, decoded_frames, grown, records, sample_until

#: Seconds between two faults, drawn; and that the run gets to end after its cameras are gone.
BETWEEN, ENDING = (30.0, 90.0), 180.0
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
            began, captured = time.monotonic(), Lines(out / "capture" / "capture.jsonl")
            faults = _Faults(servers, units, epoch, out / "faults.jsonl", given=given, over=over)
            faults.start()
            sample_until(began + 60 * given.minutes, process, out, more=captured)
            over.set()
            faults.join()
            for server in servers.values():
                server.stop()
            sample_until(time.monotonic() + ENDING, process, out, more=captured)
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
    told = records(out / "capture" / "capture.jsonl")
    lines = read_lines(out / "run" / METRICS)
    decoded, kinds = decoded_frames(out / "run" / STREAM)
    frames = [line["frame"] for line in lines]
    if not frames == decoded == list(range(len(told))):
        raise GsstreamError(f"{len(told)} instants captured, {len(frames)} lines, {len(decoded)} frames decoded")
    policies = Counter(line["live"]["policy"] or "encoded in turn" for line in lines)
    pictures = reported(out / "capture", names)
    return {
        **instants_of(told, fps),
        "files_that_lines_name": _named_files(out / "capture", told, names),
        "mixed_instants": pictures["mixed"],
        "lines": len(lines),
        "frames_decoded": len(decoded),
        "packets": kinds,
        "policies": dict(policies),
        "faults": dict(Counter(fault["what"] for fault in records(out / "faults.jsonl"))),
        **grown(records(out / "samples.jsonl")),
    }


def instants_of(told: Sequence[dict[str, Any]], fps: float) -> dict[str, Any]:
    """Return what became of the instants from the first to the last line of a capture, by the clock of the cameras.

    They follow one another within 5 % of the rig's rate; where lines are further apart, instants lie between that were
    dropped, of which the lines count, or of which no camera had a picture.
    """
    times = [line["time"] for line in told]
    between = sum(round((b - a) * fps) - 1 for a, b in itertools.pairwise(times))
    dropped, absent = (
        told[-1]["dropped"] - told[0]["dropped"],
        Counter(name for line in told for name in line["absent"]),
    )
    return {
        "instants_by_the_clock": len(told) + between,
        "captured": len(told),
        "of_all_cameras": sum(not line["absent"] for line in told),
        "dropped_by_the_capture": dropped,
        "without_any_camera": between - dropped,
        "pictures_absent": sum(absent.values()),
        "absent": dict(absent),
    }


def _named_files(folder: Path, told: Sequence[dict[str, Any]], names: Sequence[str]) -> str:
    """Compare the pictures that are there with those that the log names."""
    for name in names:
        there = {int(path.stem) for path in (folder / name).glob("*.jpg")}
        if there != {line["frame"] for line in told if name not in line["absent"]}:
            raise GsstreamError(f"{folder / name}: the pictures are not those that capture.jsonl names")
    return "all"


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
