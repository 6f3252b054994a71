"""Ten thousand frames and more: a recording there and back again for as long as is asked, and what grows meanwhile.

Usage: python -m tools.boomerang --frames 10000 --source DIR --out OUT [-- --method s2gs-edge --scale 0.5 ...]

What follows ``--`` goes to ``gsstream run``, whose source is ``disturbed:ways=N:DIR``. Writes OUT/samples.jsonl (a line
every ten seconds: memory, descriptors and threads of the run, its files, frames) and OUT/boomerang.json: lines of
``metrics.jsonl`` and frames of the decoded stream, which have to be all, memory at fifths of the time, and the means of
quality, bytes and processor time of each tenth of the frames, frame 0 apart.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from gsstream.core.errors import GsstreamError, InputError
from gsstream.encode import open_recording
from gsstream.engine.run.session import METRICS, STREAM
from gsstream.evaluation.records import mean, read_lines
from tools.drill import GSSTREAM
from tools.rehearsal import recording_of
from tools.sampling import decoded_frames, grown, records, sample_until

#: Parts of the stream whose means are told.
PARTS = 10


def boomerang(finished: str, out: Path, frames: int, options: Sequence[str]) -> dict[str, Any]:
    """Encode so many frames and return what is reported; a run that fails, or lacks a frame, is a GsstreamError."""
    if out.exists():
        raise InputError(f"{out} exists; expected a new folder, choose another --out")
    out.mkdir(parents=True)
    with open_recording(finished) as source:
        length = source.info.num_frames or 1
    ways = math.ceil((frames - 1) / max(1, length - 1))
    command = [*GSSTREAM, "run", "--source", f"disturbed:ways={ways}:{Path(finished).resolve()}", "--no-pictures"]
    command += ["--frames", str(frames), "--out", str(out / "run"), *options]
    with (out / "run.log").open("w") as log, subprocess.Popen(command, stdout=log, stderr=log) as process:
        sample_until(math.inf, process, out)
    if process.returncode:
        raise GsstreamError(f"the run ended with {process.returncode}; see {out / 'run.log'}")
    lines = read_lines(out / "run" / METRICS)
    decoded, kinds = decoded_frames(out / "run" / STREAM)
    if not [line["frame"] for line in lines] == decoded == list(range(frames)):
        raise GsstreamError(f"{frames} frames: {len(lines)} lines, {len(decoded)} decoded")
    found = {"frames": frames, "lines": len(lines), "frames_decoded": len(decoded), "packets": kinds}
    return found | grown(records(out / "samples.jsonl")) | {"parts": parts_of(lines)}


def parts_of(lines: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the means of each tenth of the later frames."""
    later = lines[1:]
    size = math.ceil(len(later) / PARTS)
    return [_part(later[at : at + size]) for at in range(0, len(later), size)]


def _part(lines: Sequence[dict[str, Any]]) -> dict[str, Any]:
    seen = (value for line in lines for value in line["psnr"].values() if value is not None)
    return {
        "frames": f"{lines[0]['frame']} to {lines[-1]['frame']}",
        "psnr": _mean(seen),
        "bytes": _mean(sum(line["bytes"].values()) for line in lines),
        "cpu_ms": _mean(1000 * line["cpu_seconds"] for line in lines),
        "gaussians": lines[-1]["num_gaussians"],
    }


def _mean(values: Iterable[float]) -> float | None:
    found = mean(values)
    return None if math.isnan(found) else round(found, 2)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run as a command; returns the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    place = words.index("--") if "--" in words else len(words)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", default="demo", help="demo, or a folder with a recording")
    parser.add_argument("--frames", type=int, default=10_000)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args(words[:place])
    if given.frames < 2:
        raise InputError(f"expected --frames of at least 2, got {given.frames}")
    found = boomerang(recording_of(given.source), given.out, given.frames, words[place + 1 :])
    text = json.dumps(found, indent=1)
    (given.out / "boomerang.json").write_text(text + "\n", encoding="utf-8")
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
