"""Read, append to and trim ``metrics.jsonl``, which holds one JSON object per frame of a run."""

from __future__ import annotations

import errno
import itertools
import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from gsstream.core.errors import InputError
from gsstream.engine.run.output import disk_errors, write_whole


def read_metrics(path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """Return (line number, line) of every frame's record, in the order of the file.

    A last line that is no JSON is left out: a run that is being written, or was killed, ends in half of one. Raises
    InputError naming file and line for anything else that is not a JSON object with a frame, and when there is no file.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read {path}: {error}; expected the metrics.jsonl of a run") from error
    for number, text in enumerate(lines, 1):
        if not text.strip():
            continue
        try:
            line = json.loads(text)
        except ValueError as error:
            if number == len(lines):
                return
            raise InputError(f"{path}:{number}: not a frame record: {error}; mend or remove the line") from error
        if not isinstance(line, dict) or not isinstance(line.get("frame"), int):
            raise InputError(f"{path}:{number}: not a frame record: expected an object with a frame, got {text[:60]!r}")
        yield number, line


def last_written(path: Path) -> int:
    """Return the last frame up to which no line of ``metrics.jsonl`` is missing, -1 when that of frame 0 is."""
    frames = {int(line["frame"]) for line in written_lines(path)}
    return next(frame for frame in itertools.count() if frame not in frames) - 1


def trim_metrics(path: Path, last: int) -> list[dict[str, Any]]:
    """Drop the lines of frames that the stream does not hold (a kill came between), and return those kept."""
    kept = [line for line in written_lines(path) if int(line["frame"]) <= last]
    if path.exists():
        add_metrics(path, kept, [])
    return kept


def append_metrics(path: Path, line: dict[str, Any]) -> None:
    """Add the record of one frame, in one write. Raises OutputError when there is no room for it, or no file.

    A run makes the file when it begins: where the file is missing later, the lines of earlier frames are lost. A line
    that was only written in part is taken back, so that what follows does not stand behind half of one.
    """
    data = (json.dumps(line) + "\n").encode()
    with disk_errors(path.parent), path.open("r+b", buffering=0) as log:
        before = log.seek(0, os.SEEK_END)
        try:
            written = log.write(data)
        except OSError:
            log.truncate(before)
            raise
        if written != len(data):
            log.truncate(before)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def add_metrics(path: Path, kept: list[dict[str, Any]], lines: Iterable[dict[str, Any]]) -> None:
    """Write the lines that are kept and more of them, in the order of frames; a kill leaves the file as it was."""
    found = sorted([*kept, *lines], key=lambda line: int(line["frame"]))
    write_whole(path, "".join(json.dumps(line) + "\n" for line in found))


def written_lines(path: Path) -> list[dict[str, Any]]:
    """Return the lines of a run that goes on; without a file, none has been written."""
    return [line for _, line in read_metrics(path)] if path.exists() else []
