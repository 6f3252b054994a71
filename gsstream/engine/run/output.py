"""The output folder of a run: one run at a time, no half files, and nothing unknown is ever deleted."""

from __future__ import annotations

import errno
import json
import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import TextIOWrapper
from pathlib import Path
from types import FrameType
from typing import Any
from weakref import finalize

from gsstream.core.errors import OutputError
from gsstream.input.recordings.origin import RECORDING

#: Held while a run writes into the folder; gone when it does not.
LOCK = "run.lock"
#: Files that say "a run lives here", and that a run may replace.
RUN_FILES = ("stream.gss", "metrics.jsonl", "recipe.yaml", RECORDING)
#: Files that are made from a finished run; a new run removes them, lest files of the old run stay behind.
MADE_FILES = ("contact_sheet.png", "frames.png", "summary.txt", "video.mp4", "gap.txt", "gap.json")


@contextmanager
def claim_output(out: Path, *, resume: bool = False, overwrite: bool = False) -> Iterator[bool]:
    """Hold the folder for one run, from before its first file is touched to after its last one is written.

    Arguments and errors are those of :func:`prepare_output`; besides, OutputError when another run holds the folder,
    saying which. The lock goes with the process, however that ends. Gives whether there is a run to continue.
    """
    check_output(out, resume=resume, overwrite=overwrite)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"the output folder {out} cannot be used: {error}") from error
    with run_lock(out):
        yield prepare_output(out, resume=resume, overwrite=overwrite)


@contextmanager
def run_lock(out: Path, what: str = "run") -> Iterator[None]:
    """Hold an existing folder for one ``what``. Raises OutputError naming process and machine that hold it already."""
    try:
        import fcntl
    except ImportError:  # no such lock on this system: the folder is not protected
        yield
        return
    path = out / LOCK
    with _opened(path) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise OutputError(
                f"another {what} works in {out}{_holder(file)}: wait for it, end it, or choose another --out"
            ) from error
        if not _is_same_file(path, file):
            raise OutputError(f"another {what} has just ended in {out}; try again")
        file.truncate(0)
        json.dump({"pid": os.getpid(), "host": socket.gethostname(), "since": time.strftime("%F %T")}, file)
        file.flush()
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def _opened(path: Path) -> TextIOWrapper:
    try:
        return path.open("a+", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"the output folder {path.parent} cannot be used: {error}") from error


def _is_same_file(path: Path, file: TextIOWrapper) -> bool:
    """Whether the file that was locked is the one of that name: its holder removes it when it is done."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False


def _holder(file: TextIOWrapper) -> str:
    """Who wrote its name into a lock, as far as it can be read."""
    file.seek(0)
    try:
        known: dict[str, Any] = json.load(file)
        return f" (process {known['pid']} on {known['host']}, since {known['since']})"
    except (ValueError, KeyError, TypeError, OSError):
        return ""


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file that is there completely or as it was before, whenever the process ends.

    Writes a temporary file in the same folder and renames it. Raises OutputError when it cannot be written.
    """
    data = content.encode() if isinstance(content, str) else content
    with disk_errors(path.parent):
        beside = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            with beside.open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            beside.replace(path)
        except BaseException:
            with suppress(OSError):
                beside.unlink()
            raise


@contextmanager
def disk_errors(out: Path) -> Iterator[None]:
    """Tell a full disk, a folder that vanished or became read-only in one sentence (OutputError)."""
    try:
        yield
    except OSError as error:
        advice = {
            errno.ENOSPC: "make room",
            errno.EDQUOT: "make room",
            errno.EROFS: "make the disk writable",
            errno.EFBIG: "make room",
            errno.EIO: "check the disk",
            errno.EACCES: "make the folder writable",
            errno.ENOENT: "do not move or delete the folder of a run",
        }.get(error.errno or 0)
        if advice is None:
            raise
        where = error.filename or out
        raise OutputError(
            f"cannot write {where}: {error.strerror}; {advice}. What is complete stays valid: continue with --resume"
        ) from error


@contextmanager
def ended_by_signals(names: tuple[str, ...] = ("SIGTERM", "SIGHUP")) -> Iterator[list[int]]:
    """Let services end a run as Ctrl-C does: after the frame in flight, with a valid stream.

    The handler of SIGINT is called for each of the signals, and decides. Gives the list of signals that came; the exit
    code that services expect is 128 plus the first. Does nothing outside of the main thread, where no handler can be
    set, and leaves a signal alone that the process was told to ignore (nohup).
    """
    came: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield came
        return

    def passed_on(number: int, frame: FrameType | None) -> None:
        came.append(number)
        handler = signal.getsignal(signal.SIGINT)
        if not callable(handler):  # ignored, as in what a shell starts in the background
            raise KeyboardInterrupt
        handler(signal.SIGINT, frame)

    before: dict[int, Any] = {}
    for name in names:
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            before[number] = signal.signal(number, passed_on)
    try:
        yield came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def prepare_output(out: Path, *, resume: bool = False, overwrite: bool = False) -> bool:
    """Make sure a run may write to ``out``, and say whether there is a run to continue. Raises OutputError if not."""
    present = check_output(out, resume=resume, overwrite=overwrite)
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name in (*RUN_FILES, *MADE_FILES) if overwrite and present else ():
            (out / name).unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"the output folder {out} cannot be used: {error}") from error
    return bool(present) and resume


def check_output(out: Path, *, resume: bool = False, overwrite: bool = False) -> list[str]:
    """Make the checks of :func:`prepare_output` and write nothing; return which ``RUN_FILES`` there are."""
    if resume and overwrite:
        raise OutputError("--resume continues the run in the output folder, --overwrite deletes it: give one of them")
    if out.exists() and not out.is_dir():
        raise OutputError(f"the output {out} is a file; expected a folder (it is created when missing)")
    present = [name for name in RUN_FILES if (out / name).exists()]
    if present and not resume and not overwrite:
        whole = "stream.gss" in present
        begun = "continue it with --resume, replace it" if whole else "it ended before frame 0: begin anew"
        raise OutputError(
            f"the output folder {out} already holds a run ({', '.join(present)}): {begun} with --overwrite, "
            "or choose another --out"
        )
    if resume and "stream.gss" not in present:
        cure = "begin anew with --overwrite" if present else "leave --resume out to start a run there"
        raise OutputError(f"nothing to resume: {out} holds no stream.gss; {cure}")
    return present


def is_finalising(frame: FrameType | None) -> bool:
    """Say whether a frame is called, however far, by the end of an object, in which no error reaches its caller."""
    while frame is not None:
        if frame.f_code is finalize.__call__.__code__ or frame.f_code.co_name == "__del__":
            return True
        frame = frame.f_back
    return False
