"""``gsstream play``, ``evaluate`` and ``info``: what can be done with a stream."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer

Stream = Annotated[Path, typer.Argument(help="A stream (.gss), or the output folder of a run.")]


def play(
    stream: Stream,
    out: Annotated[Path, typer.Option("--out", help="Folder for pictures, or a video file (.mp4).")],
    camera: Annotated[str, typer.Option("--camera", help="Camera id, or train, test, all.")] = "test",
    frames: Annotated[
        str | None, typer.Option("--frames", metavar="A:B", help="Frames A to B - 1; either may be left out.")
    ] = None,
) -> None:
    """Decode a stream and render it from its cameras."""
    first, last = _frame_range(frames)
    from gsstream.player import play as play_stream

    play_stream(stream_file(stream), out, camera=camera, first=first, last=last)


def evaluate(
    stream: Stream,
    source: Annotated[
        str | None, typer.Option("--source", help="Recording to compare with; by default the one it was made from.")
    ] = None,
) -> None:
    """Measure a stream: render the decoded frames and compare them with the recording's test cameras."""
    from gsstream.engine.evaluate import evaluate as evaluate_stream

    evaluate_stream(stream_file(stream), source)


def info(stream: Stream) -> None:
    """Say what a stream holds: method, cameras, packets and their sizes."""
    from gsstream.player import describe

    typer.echo(describe(stream_file(stream)))


def stream_file(path: Path) -> Path:
    """The stream file meant by ``path``.

    Raises InputError when there is none, naming what was looked for.
    """
    from gsstream.core.errors import InputError

    file = path / "stream.gss" if path.is_dir() else path
    if not file.is_file():
        raise InputError(f"no stream at {file}: expected a .gss file or the output folder of a run")
    return file


def _frame_range(text: str | None) -> tuple[int, int | None]:
    from gsstream.core.errors import InputError

    match = re.fullmatch(r"(\d*):(\d*)", "0:" if text is None else text)
    if match is None or (match[2] and int(match[2]) <= int(match[1] or 0)):
        raise InputError(f"--frames {text}: expected A:B with A < B, e.g. 0:30, or A: for all frames from A on")
    return int(match[1] or 0), int(match[2]) if match[2] else None
