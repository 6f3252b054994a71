"""Kill a run at every write and resume it: stream, lines and summary must be those of the run that nobody killed.

Usage: python -m tools.kills [--methods NAME ...] [--every K] [--out DIR]

A run is made once, and what it does to its folder is written down, write by write, as the system would see it. The
folder after a kill is then made from the first n of these writes, for every n, and once more with the n-th only half
done; each is resumed. So no kill is missed, and none depends on luck.
"""

from __future__ import annotations

import argparse
import builtins
import dataclasses
import io
import json
import math
import os
import shutil
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

from gsstream.cli.main import run_command
from gsstream.discovery.catalog import load_catalog
from gsstream.engine.run.output import RUN_FILES
from gsstream.engine.run.session import METRICS, STREAM
from gsstream.evaluation.records import read_lines, read_records
from gsstream.evaluation.summary import summarise

#: Numbers that depend on the clock, or on the memory that the process happened to use.
TIMES = ("seconds", "cpu_seconds", "wait_seconds", "peak_memory_mb", "cache", "budget", "live")
SOURCE = "synthetic:frames=3&views=3&width=32&height=24&supersample=1"
SETTINGS: Mapping[str, object] = {
    "first_frame.max_iterations": 8,
    "first_frame.max_points": 120,
    "first_frame.points": "recording",
    "first_frame.shell": False,
    "first_frame.prune_error": 0,
    "background": [0, 0, 0],
}


class Write(NamedTuple):
    """One thing that a run did to a file of its folder. ``name``: relative to the folder; ``at``: byte, or new size."""

    what: str  # create, write, truncate, rename, remove
    name: str
    at: int = 0
    data: bytes = b""
    to: str = ""


class Journal:
    """What was done below a folder, in order."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.writes = folder.resolve(), list[Write]()
        self._lock = threading.Lock()

    def name_of(self, path: Any) -> str | None:
        """Return a path relative to the folder; None outside of it, and for what is no path."""
        if not isinstance(path, str | os.PathLike):
            return None
        whole = Path(os.path.abspath(path))
        return str(whole.relative_to(self.folder)) if whole.is_relative_to(self.folder) else None

    def note(self, write: Write) -> None:
        """Write one down."""
        with self._lock:
            self.writes.append(write)


class _NotedFile(io.FileIO):
    """A raw file that tells a journal what reaches the system."""

    def __init__(self, path: Any, mode: str, journal: Journal, name: str) -> None:
        there = Path(path).exists()
        super().__init__(path, mode)
        self._journal, self._name, self._appends = journal, name, "a" in mode
        if not there or "w" in mode:
            journal.note(Write("create" if not there else "truncate", name))

    def write(self, data: Any) -> int:
        at = os.fstat(self.fileno()).st_size if self._appends else self.tell()
        written = super().write(data) or 0
        self._journal.note(Write("write", self._name, at, bytes(memoryview(data).cast("B")[:written])))
        return written

    def truncate(self, size: int | None = None) -> int:
        size = super().truncate(size)
        self._journal.note(Write("truncate", self._name, size))
        return size


@contextmanager
def noted(folder: Path) -> Iterator[Journal]:
    """Write down every write, truncation, renaming and removal below a folder by Python code of this process."""
    journal, real_open, real_os_open = Journal(folder), io.open, os.open

    def opened(file: Any, mode: str = "r", buffering: int = -1, *args: Any, **kwargs: Any) -> Any:
        name = journal.name_of(file) if set(mode) & set("wax+") else None
        if name is None:
            return real_open(file, mode, buffering, *args, **kwargs)
        raw = _NotedFile(file, mode.replace("b", "").replace("t", ""), journal, name)
        if "b" in mode and buffering == 0:
            return raw
        buffer: Any = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
        return buffer if "b" in mode else io.TextIOWrapper(buffer, *args, **kwargs)

    def os_opened(path: Any, flags: int, *args: Any, **kwargs: Any) -> int:
        name = journal.name_of(path) if flags & os.O_CREAT else None
        if name is not None and not os.path.exists(path):
            journal.note(Write("create", name))
        return real_os_open(path, flags, *args, **kwargs)

    def told(what: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(path: Any, *args: Any, **kwargs: Any) -> Any:
            real(path, *args, **kwargs)
            name, to = journal.name_of(path), journal.name_of(args[0]) if args else None
            if name is not None:
                journal.note(Write(what, name, to=to or ""))

        return call

    with (
        mock.patch.object(io, "open", opened),
        mock.patch.object(builtins, "open", opened),
        mock.patch.object(os, "open", os_opened),
        mock.patch.object(os, "replace", told("rename", os.replace)),
        mock.patch.object(os, "rename", told("rename", os.rename)),
        mock.patch.object(os, "unlink", told("remove", os.unlink)),
        mock.patch.object(os, "remove", told("remove", os.remove)),
    ):
        yield journal


def replay(writes: Sequence[Write], folder: Path) -> None:
    """Make a folder as these writes leave one that was empty."""
    folder.mkdir(parents=True)
    for write in writes:
        path = folder / write.name
        if write.what == "create":
            path.touch()
        elif write.what == "truncate":
            os.truncate(path, write.at)
        elif write.what == "rename":
            path.replace(folder / write.to)
        elif write.what == "remove":
            path.unlink()
        else:
            with path.open("r+b") as file:
                file.seek(write.at)
                file.write(write.data)


def kills(writes: Sequence[Write]) -> Iterator[tuple[str, Sequence[Write]]]:
    """Yield a name and the writes that were done before it, for every kill: after each write, and in its middle."""
    for number, write in enumerate(writes):
        yield f"before write {number}, to {write.name}", writes[:number]
        if len(write.data) > 1:
            half = write._replace(data=write.data[: len(write.data) // 2])
            yield f"in write {number}, to {write.name}", [*writes[:number], half]
    yield "after the last write", writes


def command(method: str, out: Path, *more: str) -> list[str]:
    """The command line of a short run."""
    sets = [item for key, value in SETTINGS.items() for item in ("--set", f"{key}={value}")]
    return ["run", "--source", SOURCE, "--method", method, "--out", str(out), "--quiet", "--no-pictures", *sets, *more]


def unbroken(method: str, out: Path, *more: str) -> list[Write]:
    """Make the run that nobody kills; what it wrote. Raises RuntimeError where the journal missed something."""
    out.mkdir(parents=True)
    with noted(out) as journal:
        code = run_command(command(method, out, *more))
    again = out.with_name(out.name + "-again")
    replay(journal.writes, again)
    same = _files(again) == _files(out)
    shutil.rmtree(again)
    if code or not same:
        raise RuntimeError(f"{method}: exit code {code}; the journal explains the folder: {same}")
    return journal.writes


def _files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def resumed(method: str, out: Path, *more: str) -> int:
    """Go on as a person would: with --resume, or anew where the run had not come to its stream; the exit code."""
    begun = any((out / name).exists() for name in RUN_FILES)
    how = ["--resume"] if (out / STREAM).exists() else ["--overwrite"] if begun else []
    return run_command(command(method, out, *more, *how))


def difference(out: Path, whole: Path) -> str:
    """Say in what a resumed run differs from the unbroken one; empty where it does not."""
    if (out / STREAM).read_bytes() != (whole / STREAM).read_bytes():
        return "the stream"
    ours, theirs = read_lines(out / METRICS), read_lines(whole / METRICS)
    number = len((out / METRICS).read_text(encoding="utf-8").splitlines())
    if [line["frame"] for line in ours] != [line["frame"] for line in theirs] or number != len(theirs):
        return f"lines of frames {[line['frame'] for line in ours]}"
    for mine, right in zip(ours, theirs, strict=True):
        # A line that was measured again has no seconds; what it has must be right, and quality is never missing.
        names = set(right) if "seconds" in mine else set(mine) | {"psnr", "ssim", "bytes", "num_gaussians"}
        wrong = [name for name in sorted(names - set(TIMES)) if mine.get(name) != right.get(name)]
        if wrong:
            return f"frame {right['frame']}: {', '.join(wrong)}"
    rows = [dataclasses.asdict(summarise(read_records(folder / METRICS))) for folder in (out, whole)]
    for name, value in rows[1].items():
        if name not in ("seconds", "seconds_first", "peak_memory_mb") and not _equal(rows[0][name], value):
            return f"summary: {name} {rows[0][name]} instead of {value}"
    return "" if (out / "summary.txt").exists() else "no summary"


def _equal(one: float, other: float) -> bool:
    return one == other or (math.isnan(one) and math.isnan(other))


def try_method(method: str, folder: Path, every: int = 1, *more: str) -> tuple[int, list[str]]:
    """Kill a method's run at every ``every``-th place; how many kills there were, and what came out wrong."""
    writes, wrong = unbroken(method, folder / "whole", *more), []
    chosen = list(kills(writes))[::every]
    for number, (name, done) in enumerate(chosen):
        out = folder / f"killed-{number}"
        replay(done, out)
        code = resumed(method, out, *more)
        found = f"exit code {code}" if code else difference(out, folder / "whole")
        if found:
            wrong.append(f"{method}, killed {name}: {found}")
        shutil.rmtree(out)
    return len(chosen), wrong


def main(argv: Sequence[str] | None = None) -> int:
    """Kill runs of all methods at every write and print a line for each; return 1 where one ended otherwise."""
    parser = argparse.ArgumentParser(prog="python -m tools.kills", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--methods", nargs="+", default=load_catalog().names("method"), metavar="NAME")
    parser.add_argument("--every", type=int, default=1, metavar="K", help="only every K-th place")
    parser.add_argument("--out", type=Path, help="folder that keeps nothing; default: a temporary one")
    given = parser.parse_args(argv)
    total, failed = 0, list[str]()
    with tempfile.TemporaryDirectory(dir=given.out) as folder:
        for method in given.methods:
            number, wrong = try_method(method, Path(folder) / method, given.every)
            total, failed = total + number, failed + wrong
            print(json.dumps({"method": method, "kills": number, "wrong": wrong}), flush=True)
    print(f"{total - len(failed)} of {total} kills resumed to stream, lines and summary of the unbroken run")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
