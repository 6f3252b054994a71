"""The folder for what was fetched: how large it may be, who uses what, and what goes when it is full."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, NamedTuple

from gsstream.core.errors import InputError
from gsstream.core.quantity import BYTES, read_quantity

FOLDER, LIMIT = "GSSTREAM_CACHE", "GSSTREAM_CACHE_SIZE"
#: Bytes that it may hold where nobody says so.
USUAL = 50e9
#: Of an entry: the bytes that it takes, dated by its last use; and that all of it is there.
SIZE, WHOLE = "size", "whole"


def cache_folder() -> Path:
    """Return ``GSSTREAM_CACHE``, or the folder ``gsstream`` where programs of this user keep such files."""
    given = os.environ.get(FOLDER)
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return Path(given) if given else base / "gsstream"


def cache_limit() -> int:
    """Return the bytes that recordings may take: ``GSSTREAM_CACHE_SIZE``. Raises InputError when it is no size."""
    text = os.environ.get(LIMIT)
    if text is None:
        return int(USUAL)
    try:
        value = read_quantity(text, BYTES)
    except ValueError as error:
        raise InputError(f"{LIMIT}={text}: {error}") from error
    if value <= 0:
        raise InputError(f"{LIMIT}={text}: expected more than 0 bytes, e.g. 50GB")
    return int(value)


class Lock:
    """Who uses an entry, across processes. Goes with the process, however that ends."""

    def __init__(self, entry: Path) -> None:
        entry.parent.mkdir(parents=True, exist_ok=True)
        self._file: IO[bytes] = entry.with_name(entry.name + ".lock").open("ab")

    def alone(self) -> None:
        """Wait until nobody else uses the entry."""
        fcntl.flock(self._file, fcntl.LOCK_EX)

    def shared(self) -> None:
        """Let others use it, and nobody remove it."""
        fcntl.flock(self._file, fcntl.LOCK_SH)

    def if_unused(self) -> bool:
        """Take the entry where nobody uses it; say whether."""
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True

    def close(self) -> None:
        """Let go."""
        self._file.close()


class _Entry(NamedTuple):
    used: float
    size: int
    path: Path


def make_room(folder: Path, entry: Path, *, size: int, missing: int) -> None:
    """Remove what was used longest ago until ``size`` bytes more are within the limit, and write ``entry/size``.

    ``missing``: bytes of these that are still to be written. Raises InputError when the limit is smaller, all the rest
    is in use, or the disk is full. Call with the entry locked.
    """
    limit = cache_limit()
    if size > limit:
        raise InputError(
            f"the recording has {told(size)}, the cache {folder} may hold {told(limit)}: set {LIMIT}, e.g. to "
            f"{told(2 * size)}"
        )
    with _one_at_a_time(folder):
        others = sorted(_entries(folder, entry))
        held = sum(other.size for other in others)
        for other in others:
            if held + size <= limit:
                break
            lock = Lock(other.path)
            try:
                if lock.if_unused():
                    shutil.rmtree(other.path, ignore_errors=True)
                    held -= other.size
            finally:
                lock.close()
        if held + size > limit:
            raise InputError(
                f"the cache {folder} may hold {told(limit)}, and {told(held)} of it are in use: set {LIMIT}, e.g. to "
                f"{told(held + size)}, or wait"
            )
        entry.mkdir(parents=True, exist_ok=True)
        (entry / SIZE).write_text(str(size), encoding="ascii")
    free = shutil.disk_usage(entry).free
    if missing > free:
        raise InputError(
            f"the recording needs {told(missing)} more in {folder}, where {told(free)} are free: make room, or set "
            f"{FOLDER} to a folder on another disk"
        )


def told(size: float) -> str:
    """Return a number of bytes as the environment takes it."""
    unit, per = next(
        (unit, per) for unit, per in (("GB", 1e9), ("MB", 1e6), ("KB", 1e3), ("B", 1)) if size >= per or per == 1
    )
    return f"{size / per:.3g}{unit}"


def _entries(folder: Path, besides: Path) -> Iterator[_Entry]:
    for path in folder.iterdir():
        note = path / SIZE
        if path != besides and note.is_file():
            yield _Entry(note.stat().st_mtime, int(note.read_text(encoding="ascii") or 0), path)


@contextmanager
def _one_at_a_time(folder: Path) -> Iterator[None]:
    """Two who make room at once would both count on the same bytes."""
    lock = Lock(folder / "room")
    try:
        lock.alone()
        yield
    finally:
        lock.close()
