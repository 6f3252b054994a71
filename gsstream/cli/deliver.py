"""``gsstream export``: streams for other programs and for web servers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from gsstream.cli.listing import plural
from gsstream.cli.streams import Frames, MaxMemory, Stream, fail_with, frame_range, progress_on, size_of, stream_file


def export(
    stream: Stream,
    out: Annotated[Path, typer.Option("--out", help="Folder for the files.")],
    kind: Annotated[
        str,
        typer.Option("--format", help="ply (3DGS), spz (by splat-transform), sequence (PLYs, list), manifest."),
    ] = "ply",
    frames: Frames = None,
    max_memory: MaxMemory = None,
    origin: Annotated[
        Literal["recording", "local"],
        typer.Option("--origin", help="Positions in the recording's coordinates, or relative to the place of its rig."),
    ] = "recording",
) -> None:
    """Write decoded frames to files that other programs open.

    A manifest (stream.json) holds no frame: it lists the byte ranges of all packets, so that any static web server can
    serve the stream.
    """
    first, last = frame_range(frames)
    most = size_of(max_memory)
    file = stream_file(stream)
    if kind == "manifest":
        typer.echo(f"wrote {_manifest(file, out)}")
        return
    from gsstream.player.export import export as export_stream
    from gsstream.player.playback import Playback

    with Playback(file, max_memory=most) as playback:
        chosen, damage = playback.sound(first, last)
    written = export_stream(
        file, out, kind, frames=chosen, progress=progress_on("frame"), max_memory=most, origin=origin
    )
    size = sum(path.stat().st_size for path in written)
    typer.echo(f"{out}: {plural(len(written), 'file')}, {size / 1e6:.1f} MB")
    fail_with(damage)


def _manifest(stream: Path, out: Path) -> Path:
    from gsstream.core.errors import OutputError
    from gsstream.player.manifest import manifest_json

    text, target = manifest_json(stream), out / "stream.json"
    try:
        out.mkdir(parents=True, exist_ok=True)
        target.write_text(text, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"cannot write {target}: {error.strerror or error}") from error
    return target
