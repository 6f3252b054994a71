"""``gsstream left-behind``: a diagnosis of motion in a finished run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def left_behind(
    run: Annotated[Path, typer.Argument(help="A stream (.gss), or the output folder of a run.")],
    source: Annotated[
        str | None, typer.Option("--source", help="The recording; default: the one the stream was made from.")
    ] = None,
) -> None:
    """Count the Gaussians that stay behind the body they belong to.

    A Gaussian of the last key frame belongs to a moving body when most cameras that have its place in their picture see
    a change there. It is outside when its place now lies in no such region, unmoved when it has gone less than a pixel.
    Shadows and what turns in place count as unmoved, too: compare runs on one recording, not recordings.
    """
    from gsstream.cli.listing import table
    from gsstream.cli.streams import check_recipe, named_recording, stream_file
    from gsstream.discovery.catalog import load_catalog
    from gsstream.engine.run.recording import reopen_recording
    from gsstream.player.playback import Playback
    from gsstream_lab.left_behind import left_behind as counts

    file, catalog = stream_file(run), load_catalog()
    with Playback(file) as playback:
        meta = playback.meta
    check_recipe(file, meta.recipe)
    recording = reopen_recording(source or named_recording(file, meta, catalog), meta.recipe, catalog)
    try:
        rows = [[str(frame), *(str(number) for number in found.values())] for frame, found in counts(file, recording)]
    finally:
        recording.close()
    typer.echo(table(["frame", "body", "outside", "unmoved"], rows))
