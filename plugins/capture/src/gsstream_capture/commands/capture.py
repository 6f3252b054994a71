"""``gsstream capture``: live cameras into a folder that grows."""

from __future__ import annotations

import signal
import threading
from pathlib import Path
from typing import Annotated

import typer


def capture(
    rig: Annotated[Path, typer.Argument(metavar="RIG.yaml", help="The rig file: cameras, calibration, rate.")],
    out: Annotated[Path | None, typer.Option("--out", help="New folder for what is captured.")] = None,
    seconds: Annotated[float | None, typer.Option("--seconds", min=0.1, help="End after so long.")] = None,
) -> None:
    """Write what live cameras see as a folder that 'gsstream run --source watch:' follows.

    Ctrl-C ends the capture; what is there stays a whole recording.
    """
    from gsstream.core.errors import InputError
    from gsstream_capture.capture import run_capture, summary
    from gsstream_capture.rig import read_rig

    found = read_rig(rig)
    if out is None:
        raise InputError("expected --out DIR, a new folder for the pictures")
    stopped = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopped.set())
    report = run_capture(found, rig.parent, out, seconds=seconds, say=_say, stopped=stopped)
    typer.echo(summary(report))
    if report.ended:
        typer.echo(f"ended: {report.ended}", err=True)


def _say(line: str) -> None:
    typer.echo(line)
