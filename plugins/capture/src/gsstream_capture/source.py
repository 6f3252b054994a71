"""``rig:RIG.yaml``: capture and encode in one command. A process of its own captures; the run follows its folder.

::

    gsstream run --source rig:RIG.yaml --method s2gs-edge --recipe recording:live --out runs/live --serve 8000

The options are those of ``watch:``, and ``folder=DIR`` for the pictures. The stream names the folder as its recording,
so that it can be evaluated and resumed from it, and no address of a camera.
"""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from pydantic import Field

from gsstream.core.errors import SourceError
from gsstream.input.recordings.base import Source, Wrapped
from gsstream.input.recordings.calibration import CALIBRATION_FILE
from gsstream.input.recordings.options import WatchOptions, options_of_query
from gsstream.input.recordings.watch import WatchSource
from gsstream_capture.rig import read_rig

#: What differs from ``watch:`` where nothing else is asked for: a live run never waits for a camera that is gone.
USUAL = {"ready": "rename", "behind": "drop", "missing": "hold", "queue": "8", "poll": "0.01"}
#: How long a camera without a picture is waited for, as a share of the time between instants. All pictures of an
#: instant get their names together, so what is not there is absent; a camera that is gone costs no other frame.
WAITED = 0.5
#: Seconds that the process that captures gets to write its last instant.
ENDING = 15.0


class RigOptions(WatchOptions):
    """Options of ``rig:RIG.yaml?key=value&...``: those of ``watch:``, and where the pictures go."""

    folder: str = Field(default="", description="new folder for the pictures; default: beside the rig file")


def open_rig(uri: str, scale: float = 1.0) -> Source:
    """Begin to capture, and follow. Raises SourceError for an unknown option, and with what the capture says."""
    text, _, query = uri.removeprefix("rig:").partition("?")
    if not text:
        raise SourceError("rig source: expected rig:RIG.yaml or rig:RIG.yaml?key=value&..., got no file")
    given, rig = {part.partition("=")[0] for part in query.split("&")}, Path(text)
    usual = USUAL | {"grace": f"{WAITED / read_rig(rig).fps:.6f}"}
    usual_query = "&".join(f"{key}={value}" for key, value in usual.items() if key not in given)
    options = options_of_query(RigOptions, "&".join(filter(None, (query, usual_query))), "rig source")
    folder = Path(options.folder) if options.folder else rig.with_name(f"{rig.stem}-{time.strftime('%Y%m%d-%H%M%S')}")
    if folder.exists() and any(folder.iterdir()):
        raise SourceError(f"rig source: folder {folder} is not empty; name a new one")
    followed = WatchOptions.model_validate(options.model_dump(exclude={"folder"}))
    return RigSource(rig, folder, followed, scale)


class RigSource(Wrapped):
    """A folder that is followed, and the process that fills it; closing ends both."""

    def __init__(self, rig: Path, folder: Path, options: WatchOptions, scale: float) -> None:
        # Ctrl-C is for the run, which ends this process when it is done; when the run is killed, the pipe breaks.
        command = [sys.executable, "-m", "gsstream_capture.child", str(rig), str(folder)]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
        )
        try:
            while not (folder / CALIBRATION_FILE).exists():
                if self._process.poll() is not None:
                    raise SourceError(self._said())
                time.sleep(0.05)
            super().__init__(WatchSource(folder, options, scale=scale))
        except BaseException:
            self._end()
            raise

    def _said(self) -> str:
        assert self._process.stderr is not None, "it has a pipe"
        lines = self._process.stderr.read().strip().splitlines()
        return lines[-1].removeprefix("error: ") if lines else f"the capture ended with {self._process.returncode}"

    def close(self) -> None:
        """End the capture and all waits."""
        super().close()
        self._end()

    def _end(self) -> None:
        process: subprocess.Popen[Any] = self._process
        for pipe in (process.stdin, process.stderr):
            if pipe is not None:
                pipe.close()
        try:
            process.wait(ENDING)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
