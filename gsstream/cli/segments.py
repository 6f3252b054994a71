"""``gsstream run-segments``: a long recording in segments that are encoded at the same time."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gsstream.cli import options
from gsstream.cli.listing import fitting, plural, table
from gsstream.cli.streams import stream_file

if TYPE_CHECKING:
    from gsstream.trade.segments.drive import SegmentsResult
    from gsstream.trade.segments.work import Wanted


class SegmentStart(StrEnum):
    """Where the first frame of a later segment comes from."""

    warm = "warm"
    open = "open"
    anew = "anew"


def run_segments(
    source: Annotated[str, typer.Option("--source", help="demo, synthetic:K=V&..., DIR, or LAYOUT:DIR.")],
    out: options.Out,
    segments: Annotated[int, typer.Option("--segments", min=1, help="Number of segments, of nearly equal length.")],
    method: options.Method = None,
    recipe: options.Recipes = None,
    settings: options.Settings = None,
    frames: options.Frames = None,
    scale: options.Scale = None,
    start: Annotated[
        SegmentStart,
        typer.Option(
            "--start",
            help="First frame of a later segment; warm: the scene of the segment before, carried over in one step; "
            "open: so, too, with every gate open; anew: reconstructed like frame 0.",
        ),
    ] = SegmentStart.warm,
    key_epochs: Annotated[
        int, typer.Option("--key-epochs", min=1, help="Epochs of the step that carries a scene from key to key frame.")
    ] = 20,
    first_frame: options.FirstFrame = None,
    workers: Annotated[int | None, options.workers("Segments")] = None,
    threads: options.Threads = 1,
    ray: options.Ray = None,
    resume: options.Resume = False,
    overwrite: options.Overwrite = False,
    no_video: options.NoVideo = False,
    no_pictures: options.NoPictures = False,
    quiet: options.Quiet = False,
) -> None:
    """Encode a recording in segments, several at a time, and join them into one stream.

    Each segment begins with a key packet, at which players can also join. A killed worker's segment goes on where it
    stopped; after Ctrl-C or a failure, --resume keeps what is finished.
    """
    from gsstream.trade.segments.work import Wanted

    changes = options.overrides(settings, frames=frames, scale=scale)
    wanted = Wanted(source, out, segments, start.value, key_epochs, first_frame, workers, threads, ray)
    gallery = {"pictures": not no_pictures, "video": not no_video}
    result = _encode(wanted, method, recipe or (), changes, (resume, overwrite), (quiet, gallery))
    if not quiet:
        typer.echo(_seams(result))


def _encode(
    wanted: Wanted, method: str | None, recipe: Sequence[Path], changes: Sequence[tuple[str, str]],
    again: tuple[bool, bool], shown: tuple[bool, dict[str, bool]],
) -> SegmentsResult:  # fmt: skip
    """``again``: resume, overwrite; ``shown``: quiet, what ``write_gallery`` takes."""
    from gsstream.plugins.catalog import load_catalog
    from gsstream.recipe.load import resolve_recipe

    catalog = load_catalog()
    resolved = resolve_recipe(method, catalog.recipe_path, recipe, changes)
    from gsstream.engine.assembly.assemble import assemble
    from gsstream.engine.run.recording import open_recording
    from gsstream.trade.jobs.executor import make_executor
    from gsstream.trade.jobs.folder import only_one
    from gsstream.trade.segments.drive import run_segments as drive
    from gsstream.trade.segments.job import run_segment
    from gsstream.trade.segments.join import first_frame_of
    from gsstream.trade.segments.work import make_work, prepare_folder
    from gsstream.trade.show.gallery import SUMMARY, write_gallery

    assembly = assemble(resolved, catalog)
    first = None if wanted.first_frame is None else first_frame_of(stream_file(wanted.first_frame))
    recording = open_recording(wanted.source, assembly.recipe, catalog)
    out, (quiet, gallery) = wanted.out, shown
    try:
        work = make_work(wanted, first, resolved, assembly, recording)
        say = (lambda _: None) if quiet else typer.echo
        # Workers are started before the folder is touched: --overwrite must not delete a run when there is no cluster.
        with closing(make_executor(run_segment, wanted.workers, wanted.threads, wanted.ray)) as executor:
            out.mkdir(parents=True, exist_ok=True)
            with only_one(out, "run"):
                prepare_folder(out, work.facts, first, resume=again[0], overwrite=again[1])
                result = drive(work.plan, work.setting, out, executor, say=say)
        written = write_gallery(out, recording, **gallery)
    finally:
        recording.close()
    if not quiet:
        typer.echo(fitting((out / SUMMARY).read_text(encoding="utf-8").rstrip()))
        typer.echo("\n".join(f"wrote {path}" for path in (out / "stream.gss", *written)))
    return result


def _seams(result: SegmentsResult) -> str:
    """The seams as a table."""
    rows = [
        [str(s.frame), _kb(s.key_bytes), _kb(s.delta_bytes), *map(_db, (s.before, s.at, s.after))]
        for s in result.seams
    ]
    made = f"{plural(result.made, 'task')} made, {result.kept} kept"
    if not rows:
        return made
    heading = ("SEAM", "KEY KB", "DELTA KB", "PSNR BEFORE", "AT", "AFTER")
    return f"{table(heading, rows)}\n{made}"


def _kb(size: float | None) -> str:
    return "-" if size is None else f"{size / 1000:.1f}"


def _db(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
