"""``gsstream play`` and ``evaluate``: pictures of a stream and how good they are."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gsstream.cli.listing import plural

if TYPE_CHECKING:
    from gsstream.player.playback import Playback

Stream = Annotated[Path, typer.Argument(help="A stream (.gss), or the output folder of a run.")]
Frames = Annotated[
    str | None, typer.Option("--frames", metavar="A:B", help="Frames A to B - 1; either may be left out.")
]


def play(
    stream: Stream,
    out: Annotated[Path, typer.Option("--out", help="Folder for pictures, or a file: .mp4, .webp or .gif.")],
    camera: Annotated[
        str | None,
        typer.Option("--camera", help="Camera id, orbit, spiral, or train, test, all; default: the first test camera."),
    ] = None,
    frames: Frames = None,
) -> None:
    """Decode a stream and render it, without torch or the recording."""
    first, last = frame_range(frames)
    file = stream_file(stream)
    from gsstream.player.play import play as play_stream
    from gsstream.player.playback import Playback

    with Playback(file) as playback:
        cameras = _cameras(playback, camera)
        chosen = chosen_frames(playback, first, last)
    for name in cameras:
        target = out if len(cameras) == 1 else _one_of_many(out, name or "")
        played = play_stream(file, target, camera=name, frames=chosen, progress=progress_on(name or "camera"))
        typer.echo(f"{played.path}: {plural(played.frames, 'picture')}")


def evaluate(
    stream: Stream,
    source: Annotated[
        str | None, typer.Option("--source", help="Recording to compare with; default: the one it was made from.")
    ] = None,
    lpips_onnx: Annotated[
        Path | None,
        typer.Option("--lpips-onnx", help="LPIPS as an ONNX file (docs/howto/lpips.md); default: not measured."),
    ] = None,
    lpips_range: Annotated[
        str | None,
        typer.Option(
            "--lpips-range", metavar="-1|0", help="Lower end of the range that file is given; default: its metadata."
        ),
    ] = None,
) -> None:
    """Render the decoded frames and compare them with the recording's test cameras."""
    file = stream_file(stream)
    from gsstream.core.errors import InputError
    from gsstream.engine.run.recording import reopen_recording
    from gsstream.metrics import OnnxLpips
    from gsstream.player.playback import Playback
    from gsstream.plugins.catalog import load_catalog
    from gsstream.trade.evaluate import evaluate as evaluate_stream

    if lpips_range is not None and lpips_onnx is None:
        raise InputError(f"--lpips-range {lpips_range}: without --lpips-onnx there is no LPIPS to give it to")
    lpips = None if lpips_onnx is None else OnnxLpips(lpips_onnx, lpips_range)
    with Playback(file) as playback:
        meta = playback.meta
    uri = source or meta.extra.get("source_uri")
    if not uri:
        raise InputError(f"{file} does not say which recording it was made from; name it with --source")
    recording = reopen_recording(str(uri), meta.recipe, load_catalog())
    try:
        evaluation = evaluate_stream(file, recording, lpips=lpips, progress=progress_on("frame"))
    finally:
        recording.close()
    typer.echo(evaluation.table())


def stream_file(path: Path) -> Path:
    """The stream file meant by ``path``.

    Raises InputError when there is none, naming what was looked for.
    """
    from gsstream.core.errors import InputError

    file = path / "stream.gss" if path.is_dir() else path
    if not file.is_file():
        raise InputError(f"no stream at {file}: expected a .gss file or the output folder of a run")
    return file


def _one_of_many(out: Path, camera: str) -> Path:
    """Several cameras make one file or folder each, named after the camera."""
    return out.with_name(f"{out.stem}-{camera}{out.suffix}") if out.suffix else out / camera


def _cameras(playback: Playback, wanted: str | None) -> list[str | None]:
    """Ids meant by --camera; None is the player's own choice."""
    from gsstream.core.errors import InputError

    train, test = list(playback.meta.train.ids), list(playback.meta.test.ids)
    groups: dict[str | None, list[str]] = {"train": train, "test": test, "all": train + test}
    found = groups.get(wanted)
    if found is None:
        return [wanted]
    if not found:
        raise InputError(f"--camera {wanted}: this stream has no {wanted} cameras")
    return list(found)


def chosen_frames(playback: Playback, first: int | None, last: int | None) -> list[int]:
    """Frame indices from ``first`` to ``last`` - 1, by default all. Raises InputError outside the stream."""
    start = playback.frames[0] if first is None else first
    stop = playback.frames[-1] + 1 if last is None else last
    for edge in (start, stop - 1):
        playback.entry(edge)  # says which frames there are when this one is not
    return list(range(start, stop))


def frame_range(text: str | None) -> tuple[int | None, int | None]:
    """A and B of "A:B"; None where one is left out."""
    from gsstream.core.errors import InputError

    match = re.fullmatch(r"(\d*):(\d*)", ":" if text is None else text)
    first, last = (int(number) if number else None for number in match.groups()) if match else (0, 0)
    if last is not None and last <= (first or 0):
        raise InputError(f"--frames {text}: expected A:B with A < B, e.g. 0:30, or A: for all frames from A on")
    return first, last


def progress_on(what: str) -> Callable[[int, int], None] | None:
    """A counter that overwrites itself on a terminal; silent elsewhere."""
    if not sys.stderr.isatty():
        return None

    def show(done: int, total: int) -> None:
        typer.echo(f"\r{what} {done}/{total}", nl=done == total, err=True)

    return show
