"""Errors of the system that can meet any command, as one sentence: no room, a name too long, no memory."""

from __future__ import annotations

import errno
import os
import sys
from contextlib import suppress

from gsstream.core.memory import VARIABLE

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
#: What torch says, in a RuntimeError, when its allocator fails.
_TORCH = "DefaultCPUAllocator: can't allocate memory"


def describe(error: BaseException) -> tuple[int, str] | None:
    """Return exit code and sentence of an error of the system; None for every other one, which is a defect."""
    if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and _TORCH in str(error)):
        return 1, (
            "this takes more memory than the system gives; take smaller pictures, fewer Gaussians or a shorter "
            f"recording, or lower the environment variable {VARIABLE}, so that it is refused before"
        )
    if not isinstance(error, OSError):
        return None
    where = f" {os.fspath(error.filename)!s}" if isinstance(error.filename, str | os.PathLike) else ""
    if error.errno == errno.ENAMETOOLONG:
        return 2, f"the name{_shortened(where)} is too long for this system; expected at most 255 bytes between two '/'"
    if error.errno in _FULL:
        return 1, f"cannot write{where or ' the output'}: {error.strerror}; make room"
    return None


def flush_output() -> None:
    """Write out what was printed, so that a full disk is an error here and not at the end of the process."""
    if sys.stdout is not None and not sys.stdout.closed:
        sys.stdout.flush()


def drop_output() -> None:
    """Forget what could not be printed, which the end of the process would try again."""
    with suppress(OSError, ValueError, AttributeError):
        number = sys.stdout.fileno()
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), number)


def _shortened(name: str) -> str:
    return name if len(name) <= 100 else f"{name[:60]} ... ({len(os.fsencode(name))} bytes)"
