"""Folders that jobs share: recordings as every worker finds them, and an output folder held by one process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gsstream.core.errors import OutputError

LOCK = "sweep.lock"


def recording_uri(uri: str, data: Path | None) -> str:
    """Return the recording as a worker opens it, wherever it works: a relative folder lies in ``data``, or here."""
    scheme, colon, rest = uri.rpartition(":")
    folder = (data or Path()) / rest
    return f"{scheme}{colon}{folder.resolve()}" if uri != "demo" and rest and folder.is_dir() else uri


@contextmanager
def only_one(out: Path, what: str) -> Iterator[None]:
    """Hold the folder for one sweep or run; the lock goes with the process, however it ends."""
    try:
        import fcntl
    except ImportError:  # no such lock on this system: the folder is not protected
        yield
        return
    with (out / LOCK).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise OutputError(f"another {what} works in {out}; wait for it, or choose another --out") from error
        yield
