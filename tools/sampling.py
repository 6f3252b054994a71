"""What a run takes while it lives: memory, descriptors, threads and files, a line every ten seconds (Linux)."""

from __future__ import annotations

import json
import os
import subprocess
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gsstream.engine.run.session import METRICS, STREAM
from gsstream.player.playback import Playback

#: Seconds between two samples.
SAMPLE = 10.0


def sample_until(end: float, process: subprocess.Popen[Any], out: Path, *, more: Lines | None = None) -> None:
    """Write OUT/samples.jsonl about the run in OUT/run and the process that it has started, if any.

    Arguments:
        end: by ``time.monotonic``; it ends earlier when the run does.
        more: a growing file, of which the lines are counted as ``instants``.
    """
    encoded = Lines(out / "run" / METRICS)
    with (out / "samples.jsonl").open("a", encoding="utf-8") as file:
        while time.monotonic() < end and process.poll() is None:
            line = {
                "time": round(time.time(), 1),
                "run": facts_of(process.pid),
                "capture": next(map(facts_of, _children(process.pid)), None),
                "files_of_the_run": len(list((out / "run").iterdir())) if (out / "run").exists() else 0,
                "instants": 0 if more is None else more.count(),
                "frames": encoded.count(),
                "bytes": (out / "run" / STREAM).stat().st_size if (out / "run" / STREAM).exists() else 0,
                "load": os.getloadavg()[0],
            }
            file.write(json.dumps(line) + "\n")
            file.flush()
            _wait(process, min(SAMPLE, max(0.0, end - time.monotonic())))


def _wait(process: subprocess.Popen[Any], seconds: float) -> None:
    try:
        process.wait(seconds)
    except subprocess.TimeoutExpired:
        return


class Lines:
    """How many lines a growing file has; each look reads what came since the one before."""

    def __init__(self, path: Path) -> None:
        self._path, self._at, self._lines = path, 0, 0

    def count(self) -> int:
        """Return the number of whole lines; 0 while there is no file."""
        if not self._path.exists():
            return 0
        with self._path.open("rb") as file:
            file.seek(self._at)
            data = file.read()
        self._at, self._lines = self._at + len(data), self._lines + data.count(b"\n")
        return self._lines


def facts_of(process: int) -> dict[str, float] | None:
    """Return memory in MB, descriptors, threads and processor seconds of a process; None when it is gone."""
    place = Path(f"/proc/{process}")
    try:
        fields = (place / "stat").read_text(encoding="ascii").rpartition(")")[2].split()
        ticks = int(fields[11]) + int(fields[12])
        descriptors, threads = len(list((place / "fd").iterdir())), len(list((place / "task").iterdir()))
    except OSError:
        return None
    seconds = round(ticks / os.sysconf("SC_CLK_TCK"), 1)
    return {"mb": resident_mb(process), "descriptors": descriptors, "threads": threads, "cpu_s": seconds}


def resident_mb(process: int) -> int:
    """Return the resident size of a process in MB; 0 when it is gone."""
    try:
        text = Path(f"/proc/{process}/status").read_text(encoding="ascii")
    except OSError:
        return 0
    found = [line.split()[1] for line in text.splitlines() if line.startswith("VmRSS")]
    return int(found[0]) // 1024 if found else 0


def _children(process: int) -> list[int]:
    found = []
    for task in Path(f"/proc/{process}/task").glob("*/children"):
        try:
            found += [int(child) for child in task.read_text(encoding="ascii").split()]
        except OSError:
            continue
    return sorted(found)


def grown(samples: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return memory, descriptors and threads of each process at fifths of the time, and the most.

    The first fifth holds the first frame and its refinement, so the first of the five numbers is at its end.
    """
    full = [sample for sample in samples if sample["run"] and sample["frames"]]  # none of a run of some seconds
    out: dict[str, Any] = {}
    for process in ("run", "capture"):
        seen = [sample[process] for sample in full if sample[process]]
        for key in ("mb", "descriptors", "threads") if seen else ():
            values = [facts[key] for facts in seen]
            out[f"{process}_{key}"] = [values[int(share * (len(values) - 1) / 5)] for share in range(1, 6)]
            out[f"{process}_most_{key}"] = max(values)
    return out | {"files_of_the_run": max((sample["files_of_the_run"] for sample in full), default=0)}


def decoded_frames(stream: Path) -> tuple[list[int], dict[str, int]]:
    """Decode a stream from its first packet to its last; return the frames, and the number of packets of each kind."""
    with Playback(stream) as playback:
        found = []
        for frame in playback.frames:
            playback.player_state(frame)
            found.append(frame)
        return found, dict(Counter(playback.entry(frame).kind.name.lower() for frame in found))


def records(path: Path) -> list[dict[str, Any]]:
    """Return the lines of a file of JSON."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
