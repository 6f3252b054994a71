"""``gsstream export``: streams for other programs and for web servers."""

from __future__ import annotations

import tempfile
import threading
from pathlib import Path
from typing import Annotated, Literal

import typer

from gsstream.cli.listing import plural
from gsstream.cli.streams import Frames, MaxMemory, Stream, fail_with, frame_range, progress_on, size_of, stream_file
from gsstream.core.errors import InputError, OutputError
from gsstream.core.memory import limited_memory
from gsstream.store.address import is_address


def export(
    stream: Stream,
    to: Annotated[
        str, typer.Option("--out", help="Folder for the files; of a page and a live page also s3://BUCKET/DIR.")
    ],
    kind: Annotated[
        Literal["ply", "spz", "glb", "sequence", "usd", "4dgs", "manifest", "page", "live"],
        typer.Option("--format", help="PLYs, SPZs, GLBs, PLYs with a list; one file of OpenUSD or 4dgs; for the web."),
    ] = "ply",
    frames: Frames = None,
    max_memory: MaxMemory = None,
    origin: Annotated[
        Literal["recording", "local"],
        typer.Option("--origin", help="Positions in the recording's coordinates, or relative to the place of its rig."),
    ] = "recording",
    rendition: Annotated[
        list[Path] | None,
        typer.Option(
            "--rendition",
            metavar="RUN",
            help="Of a page: another run of the recording that viewers may choose; repeat it.",
        ),
    ] = None,
    join_every: Annotated[
        float,
        typer.Option("--join-every", metavar="SECONDS", help="Of a page: between points to join at; 0: none."),
    ] = 10.0,
) -> None:
    """Write a stream for other programs, or as a page for any web server.

    A page is a folder with the browser player and the stream in segments; one that is there is replaced. A manifest
    (stream.json) holds no frame: it lists the byte ranges of all packets, so that any static web server can serve the
    stream. A live page shows a run while it is written: parts that never change, and a manifest that rolls.
    """
    if rendition and kind != "page":
        raise InputError("--rendition is for --format page")
    if kind in ("page", "live"):
        with limited_memory(size_of(max_memory)):
            _web(kind, stream, to, frames=frames, renditions=rendition or [], join_every=join_every)
        return
    if is_address(to):
        raise InputError(f"--out {to}: only --format page and live go to an address; name a folder")
    first, last = frame_range(frames)
    most, file, out = size_of(max_memory), stream_file(stream), Path(to)
    if kind == "manifest":
        typer.echo(f"wrote {_manifest(file, out)}")
        return
    from gsstream.player.export import export as export_stream
    from gsstream.player.playback import Playback

    with Playback(file, max_memory=most) as playback:
        chosen, damage = playback.sound(first, last)
    tell = progress_on("frame")
    written = export_stream(
        file, out, kind, frames=chosen, progress=tell, max_memory=most, origin=origin, said=typer.echo
    )
    size = sum(path.stat().st_size for path in written)
    typer.echo(f"{out}: {plural(len(written), 'file')}, {size / 1e6:.1f} MB")
    fail_with(damage)


def _web(kind: str, stream: Path, to: str, *, frames: str | None, renditions: list[Path], join_every: float) -> None:
    """Write a page, recorded or live."""
    if frames is not None:
        raise InputError(f"--frames {frames}: a page holds all frames of a stream; leave --frames out")
    if kind == "live":
        _live(stream, to)
    else:
        _page(stream_file(stream), to, [stream_file(path) for path in renditions], join_every)


def _live(stream: Path, to: str) -> None:
    """Bring a stream to a place as it is written, until it ends or Ctrl-C."""
    from gsstream.cli.open import coming
    from gsstream.serve.follow import Follower
    from gsstream.serve.parts import LivePackage
    from gsstream.store.place import place_at

    follower = Follower(coming(stream))
    package = LivePackage(follower, place_at(to))
    package.write_page()
    typer.echo(f"{package.place.address}: the page is there, and the stream as it is written (Ctrl-C ends)")
    try:
        package.run(threading.Event(), lambda line: typer.echo(f"note: {line}", err=True))
    finally:
        follower.close()


def _page(stream: Path, to: str, renditions: list[Path], join_every: float) -> None:
    from gsstream.serve.package import package

    if is_address(to):
        from gsstream.serve.parts import bring_page
        from gsstream.store.place import place_at

        place = place_at(to)
        with tempfile.TemporaryDirectory(prefix="page-") as folder:
            package(stream, folder, renditions=renditions, join_every=join_every)
            count = bring_page(Path(folder), place)
        typer.echo(f"{place.address}: {plural(count, 'file')}")
        return
    done = package(stream, to, renditions=renditions, join_every=join_every)
    typer.echo(
        f"{done.folder}: {plural(done.segments, 'segment')}, {done.stream_bytes / 1e6:.2f} MB, "
        f"{plural(done.joins, 'join')}, {done.join_bytes / 1e6:.2f} MB, "
        f"and the player, {done.player_bytes / 1e3:.0f} KB"
    )
    typer.echo(
        f"look at it: python -m http.server --directory {done.folder} --bind 127.0.0.1 8000, http://127.0.0.1:8000"
    )


def _manifest(stream: Path, out: Path) -> Path:
    from gsstream.player.manifest import manifest_json

    text, target = manifest_json(stream), out / "stream.json"
    try:
        out.mkdir(parents=True, exist_ok=True)
        target.write_text(text, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"cannot write {target}: {error.strerror or error}") from error
    return target
