"""The process that captures for ``rig:``: it ends when its standard input does, which ends with the run."""

from __future__ import annotations

import os
import sys
import threading
from pathlib import Path

from gsstream.core.errors import GsstreamError
from gsstream_capture.capture import run_capture
from gsstream_capture.rig import read_rig


def main() -> int:
    """Capture ``argv[1]``, a rig file, into ``argv[2]``; returns the exit code."""
    rig, out = map(Path, sys.argv[1:3])
    stopped = threading.Event()

    def wait() -> None:
        sys.stdin.buffer.read()
        stopped.set()

    threading.Thread(target=wait, daemon=True).start()
    try:
        run_capture(read_rig(rig), rig.parent, out, seconds=None, say=_say, stopped=stopped)
    except GsstreamError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        return 2
    return 0


def _say(line: str) -> None:
    print(line, flush=True)


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    os._exit(code)  # a thread may still wait for its camera
