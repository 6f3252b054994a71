"""``gsstream capture``: live cameras into a folder that grows."""

from __future__ import annotations

import signal
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from gsstream_capture.board.hint import Hint

#: Seconds that a check looks, and between two hints.
CHECK = 10.0
HINT_EVERY = 4.0


def capture(
    rig: Annotated[Path, typer.Argument(metavar="RIG.yaml", help="The rig file: cameras, calibration, rate.")],
    out: Annotated[Path | None, typer.Option("--out", help="New folder for what is captured.")] = None,
    seconds: Annotated[float | None, typer.Option("--seconds", min=0.1, help="End after so long.")] = None,
    raw: Annotated[
        bool, typer.Option("--raw", help="Pictures as they come, without a calibration: takes of a board.")
    ] = False,
    check: Annotated[
        bool, typer.Option("--check", help="Look at all cameras for ten seconds, and say what is found.")
    ] = False,
    background: Annotated[
        bool, typer.Option("--background", help="Thirty instants, and their median: the empty room.")
    ] = False,
) -> None:
    """Write what live cameras see as a folder that 'gsstream run --source watch:' follows.

    Ctrl-C ends the capture; what is there stays a whole recording. With --raw, and a board.yaml beside the folder, it
    says which part of each camera's picture the board has not been in. With --background it ends by itself, and beside
    each camera's pictures is background.jpg, in which nobody is who was not in the way half of the time.
    """
    from gsstream.core.errors import InputError
    from gsstream_capture.capture import run_capture
    from gsstream_capture.report import summary
    from gsstream_capture.rig import read_rig

    found = read_rig(rig)
    if check:
        from gsstream_capture.check import check as look_at

        where = out or rig.with_name(f"{rig.stem}-check-{time.strftime('%Y%m%d-%H%M%S')}")
        look_at(found, rig.parent, where, seconds=seconds or CHECK, say=_say)
        return
    if out is None:
        raise InputError("expected --out DIR, a new folder for the pictures")
    if background and (raw or seconds is not None):
        raise InputError("--background takes thirty instants with a calibration: leave out --raw and --seconds")
    stopped = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopped.set())
    if background:
        from gsstream_capture.background import save_background

        typer.echo(summary(save_background(found, rig.parent, out, say=_say, stopped=stopped)))
        return
    hint = _hint(out, [camera.id for camera in found.cameras]) if raw else None
    report = run_capture(
        found, rig.parent, out, seconds=seconds, say=_say, stopped=stopped, raw=raw, look=hint.look if hint else None
    )
    typer.echo("\n".join([summary(report), *(hint.lines() if hint else ())]))
    if report.ended:
        typer.echo(f"ended: {report.ended}", err=True)


class _Spoken:
    """A hint that is said every few seconds."""

    def __init__(self, hint: Hint) -> None:
        self._hint, self._said = hint, time.monotonic()

    def look(self, camera: int, pixels: Any) -> None:
        self._hint.look(camera, pixels)
        if time.monotonic() - self._said > HINT_EVERY:
            self._said = time.monotonic()
            _say("\n".join(self._hint.lines()))

    def lines(self) -> list[str]:
        return self._hint.lines()


def _hint(out: Path, names: list[str]) -> _Spoken | None:
    from gsstream_capture.board.design import read_board
    from gsstream_capture.board.hint import Hint
    from gsstream_capture.board.takes import BOARD_FILE

    path = out.parent / BOARD_FILE
    return _Spoken(Hint(read_board(path), names)) if path.exists() else None


def _say(line: str) -> None:
    typer.echo(line)
