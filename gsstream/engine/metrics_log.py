"""metrics.jsonl of a run that goes on: what was written down, up to where, and what of it stays."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any


def _written(path: Path) -> list[dict[str, Any]]:
    """The complete lines of a run's metrics."""
    lines: list[dict[str, Any]] = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
        try:
            lines.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return lines


def last_written(path: Path) -> int:
    """Last frame up to which no line is missing; -1: none."""
    frames = {int(line["frame"]) for line in _written(path)}
    return next(frame for frame in itertools.count(-1) if frame + 1 not in frames)


def trim_metrics(path: Path, last: int) -> list[dict[str, Any]]:
    """Drop lines of frames that the stream does not hold (a kill can fall between packet and line); those that stay."""
    kept = [line for line in _written(path) if int(line["frame"]) <= last]
    if path.exists():
        path.write_text("".join(json.dumps(line) + "\n" for line in kept), encoding="utf-8")
    return kept
