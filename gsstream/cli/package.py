"""``gsstream package``: a stream and its player as a folder for any web server."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gsstream.cli.listing import plural
from gsstream.cli.streams import Stream, stream_file


def package(
    stream: Stream,
    out: Annotated[Path, typer.Option("--out", help="Folder for the page; a package that is there is replaced.")],
    rendition: Annotated[
        list[Path] | None,
        typer.Option("--rendition", help="Another run of the same recording that viewers may choose; repeat it."),
    ] = None,
    join_every: Annotated[
        float,
        typer.Option("--join-every", metavar="SECONDS", help="Seconds between points to join a segment at; 0: none."),
    ] = 10.0,
) -> None:
    """Write a folder with the browser player and the stream for any web server."""
    file = stream_file(stream)
    others = [stream_file(path) for path in rendition or []]
    from gsstream.serve.package import package as write_package

    done = write_package(file, out, renditions=others, join_every=join_every)
    typer.echo(
        f"{done.folder}: {plural(done.segments, 'segment')}, {done.stream_bytes / 1e6:.2f} MB, "
        f"{plural(done.joins, 'join')}, {done.join_bytes / 1e6:.2f} MB, "
        f"and the player, {done.player_bytes / 1e3:.0f} KB"
    )
    typer.echo(f"look at it: python -m http.server --directory {done.folder} --bind 127.0.0.1 8000, http://127.0.0.1:8000")
