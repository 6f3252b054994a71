"""``gsstream gap``: how far a stream lies behind fresh reconstructions of its frames."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gsstream.cli.streams import check_recipe, named_recording, progress_on, stream_file
from gsstream.core.errors import InputError

if TYPE_CHECKING:
    from gsstream_lab.gap.again import Again
    from gsstream_lab.gap.fresh import FreshFrames
    from gsstream_lab.gap.measure import Gap


def gap(
    run: Annotated[Path, typer.Argument(help="Output folder of a run.")],
    at: Annotated[
        str | None,
        typer.Option("--at", metavar="A,B,...", help="Frames to compare; default: a third, two thirds, the last."),
    ] = None,
    cache: Annotated[
        Path | None,
        typer.Option("--cache", help="Folder that keeps the reconstructions; runs may share it; default: RUN/fresh."),
    ] = None,
    epochs: Annotated[
        int | None,
        typer.Option("--epochs", min=1, help="Passes of a reconstruction over its images; default: the recipe's."),
    ] = None,
    source: Annotated[
        str | None, typer.Option("--source", help="The recording; default: the one the stream was made from.")
    ] = None,
    again: Annotated[
        bool,
        typer.Option("--again", help="Compare with the first time instead, where a recording shows pictures again."),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Every view of every frame as JSON, for scripts.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print only the table, warnings and errors.")] = False,
) -> None:
    """Reconstruct frames of a run from their own images alone and say how much better they are.

    A reconstruction is made by the run's recipe for frame 0, with seeds of that frame, and kept: the same command goes
    on where it was stopped. The table (gap.txt) and every number (gap.json) are written beside the stream, and the
    contact sheet shows both close up. Give enough passes: below about 150, a fresh reconstruction may be worse than the
    cameras allow, and the gap too small.

    With --again nothing is reconstructed: of a recording that goes there and back again (disturbed:ways=3:URI) the
    table says what each time that it is gone through has lost of the first.
    """
    from gsstream.discovery.catalog import load_catalog
    from gsstream.engine.run.recording import open_recording
    from gsstream.player.playback import Playback
    from gsstream.recipe.load import load_recipe
    from gsstream_lab.gap.again import measure_again
    from gsstream_lab.gap.fresh import FreshFrames, check_cameras
    from gsstream_lab.gap.measure import default_frames

    file = stream_file(run)
    if not run.is_dir() or not (run / "recipe.yaml").is_file():
        raise InputError(f"no recipe at {run / 'recipe.yaml'}: expected the output folder of 'gsstream run'")
    catalog, recipe = load_catalog(), load_recipe(run / "recipe.yaml").recipe
    with Playback(file) as playback:
        frames, meta = playback.frames, playback.meta
    check_recipe(file, meta.recipe)
    chosen = _frames(at, frames) if at is not None else default_frames(frames)
    with closing(open_recording(source or named_recording(file, meta, catalog), recipe, catalog)) as recording:
        check_cameras(meta, recording.info)
        if again:
            found: Again | Gap = measure_again(file, recording, progress=progress_on("frame"))
        else:
            fresh = FreshFrames.of_run(recipe, recording, cache or run / "fresh", catalog=catalog, epochs=epochs)
            found = _from_fresh(run, file, fresh, chosen, quiet=quiet)
    typer.echo(found.to_json() if as_json else found.table())


def _from_fresh(run: Path, file: Path, fresh: FreshFrames, chosen: list[int], *, quiet: bool) -> Gap:
    """Make the reconstructions that are not there yet, compare, and write what was found beside the stream."""
    from gsstream.engine.run.output import write_whole
    from gsstream.evaluation.gallery import write_sheet
    from gsstream_lab.gap.measure import GAP_FILES, measure_gap

    for frame in chosen:
        _make(fresh, frame, quiet)
    files = {frame: fresh.file(frame).resolve() for frame in chosen}
    found = measure_gap(file, files, fresh.source, fresh.epochs, progress=progress_on("frame"))
    for name, text in zip(GAP_FILES, (found.table(), found.to_json()), strict=True):
        write_whole(run / name, text + "\n")
    write_sheet(run, fresh.source, files)
    return found


def _make(fresh: FreshFrames, frame: int, quiet: bool) -> None:
    """Reconstruct a frame unless it is there, with a counter on a terminal and one line when it is done."""
    started = time.perf_counter()
    made = fresh.make(frame, (lambda *_: None) if quiet else _counter())
    if not quiet:
        seconds = f"reconstructed in {time.perf_counter() - started:.0f} s" if made else "kept"
        typer.echo(f"frame {frame}: {seconds}, {fresh.file(frame)}", err=True)


def _counter() -> Callable[[int, int, int], None]:
    live, shown = sys.stderr.isatty(), [time.monotonic()]

    def show(frame: int, done: int, total: int) -> None:
        if live:
            typer.echo(f"\rframe {frame}: iteration {done}/{total}", nl=done == total, err=True)
        elif time.monotonic() - shown[0] > 10:
            shown[0] = time.monotonic()
            typer.echo(f"frame {frame}: iteration {done}/{total}", err=True)

    return show


def _frames(text: str, there: range) -> list[int]:
    """The frames meant by --at, in order, each once."""
    try:
        found = sorted({int(part) for part in text.split(",")})
    except ValueError:
        raise InputError(f"--at {text}: expected frames such as 10,20,29") from None
    if missing := [frame for frame in found if frame not in there]:
        raise InputError(f"--at: the stream has frames {there[0]} to {there[-1]}, got {', '.join(map(str, missing))}")
    return found
