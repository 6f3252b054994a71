"""``gsstream run-segments``: a long recording in segments that are encoded at the same time."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from contextlib import closing
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import typer

from gsstream.cli import options
from gsstream.cli.listing import plural, table
from gsstream.cli.streams import stream_file

if TYPE_CHECKING:
    from gsstream.engine.assembly.assemble import Assembly
    from gsstream.recipe.load import ResolvedRecipe
    from gsstream.source.base import FrameSource
    from gsstream.trade.segments.drive import SegmentsResult, Setting
    from gsstream.trade.segments.plan import SegmentPlan


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
    quiet: options.Quiet = False,
) -> None:
    """Encode a recording in segments, several at a time, and join them into one stream.

    Each segment begins with a key packet, at which players can also join. A killed worker's segment goes on where it
    stopped; after Ctrl-C or a failure, --resume keeps what is finished.
    """
    changes = options.overrides(settings, frames=frames, scale=scale)
    wanted = Wanted(source, out, segments, start.value, key_epochs, first_frame, workers, threads, ray)
    result = _encode(wanted, method, recipe or (), changes, (resume, overwrite), (quiet, not no_video))
    if not quiet:
        typer.echo(_seams(result))


class Wanted(NamedTuple):
    """What was asked for besides the recipe."""

    source: str
    out: Path
    segments: int
    start: Literal["warm", "open", "anew"]
    key_epochs: int
    first_frame: Path | None
    workers: int | None
    threads: int
    ray: str | None


def _encode(
    wanted: Wanted, method: str | None, recipe: Sequence[Path], changes: Sequence[tuple[str, str]],
    again: tuple[bool, bool], shown: tuple[bool, bool],
) -> SegmentsResult:  # fmt: skip
    """``again``: resume, overwrite; ``shown``: quiet, video."""
    from gsstream.plugins.catalog import load_catalog
    from gsstream.recipe.load import resolve_recipe

    catalog = load_catalog()
    resolved = resolve_recipe(method, catalog.recipe_path, recipe, changes)
    from gsstream.engine.assembly.assemble import assemble
    from gsstream.engine.run.recording import open_recording
    from gsstream.trade.gallery import SUMMARY, write_gallery
    from gsstream.trade.segments.drive import run_segments as drive
    from gsstream.trade.segments.job import run_segment
    from gsstream.trade.segments.join import first_frame_of
    from gsstream.trade.sweep.drive import only_one
    from gsstream.trade.sweep.executor import make_executor

    assembly = assemble(resolved, catalog)
    first = None if wanted.first_frame is None else first_frame_of(stream_file(wanted.first_frame))
    recording = open_recording(wanted.source, assembly.recipe, catalog)
    out, (quiet, video) = wanted.out, shown
    try:
        work = _work(wanted, first, resolved, assembly, recording)
        say = (lambda _: None) if quiet else typer.echo
        # Workers before the folder is touched: --overwrite must not delete a run for want of a cluster.
        with closing(make_executor(run_segment, wanted.workers, wanted.threads, wanted.ray)) as executor:
            out.mkdir(parents=True, exist_ok=True)
            with only_one(out, "run"):
                _prepare(out, work.facts, first, resume=again[0], overwrite=again[1])
                result = drive(work.plan, work.setting, out, executor, say=say)
        written = write_gallery(out, recording, video=video)
    finally:
        recording.close()
    if not quiet:
        typer.echo((out / SUMMARY).read_text(encoding="utf-8").rstrip())
        typer.echo("\n".join(f"wrote {path}" for path in (out / "stream.gss", *written)))
    return result


class SegmentWork(NamedTuple):
    """What is to be done; ``facts`` must be the same to go on with it."""

    plan: SegmentPlan
    setting: Setting
    facts: dict[str, Any]


def _work(
    wanted: Wanted, first: bytes | None, resolved: ResolvedRecipe, assembly: Assembly, recording: FrameSource
) -> SegmentWork:
    from gsstream.core.errors import InputError
    from gsstream.recipe.load import recipe_hash
    from gsstream.trade.segments.drive import Setting
    from gsstream.trade.segments.plan import make_plan
    from gsstream.trade.sweep.drive import recording_uri

    number = recording.info.num_frames
    if number is None:
        raise InputError(f"{wanted.source!r} grows while it is read: nobody knows where its segments end; use 'run'")
    total = min(number, assembly.recipe.frames or number)
    plan = make_plan(total, wanted.segments, wanted.start, first_given=first is not None)
    uri = recording_uri(wanted.source, None)
    setting = Setting(uri, resolved, _carrying(resolved, assembly, wanted), wanted.ray is None)
    facts = {
        "source": uri, "segments": wanted.segments, "frames": total, "start": wanted.start,
        "key_epochs": wanted.key_epochs, "recipe": recipe_hash(assembly.recipe),
        "first_frame": None if first is None else f"{zlib.crc32(first):08x}",
    }  # fmt: skip
    return SegmentWork(plan, setting, facts)


def _carrying(resolved: ResolvedRecipe, assembly: Assembly, wanted: Wanted) -> ResolvedRecipe:
    """The recipe of a leap. Raises InputError where there are no gates to open."""
    from gsstream.core.errors import InputError
    from gsstream.trade.segments.carry import leap_recipe, open_leap_recipe

    if wanted.start != "open":
        return leap_recipe(resolved, wanted.key_epochs, assembly.whole)
    if assembly.whole is not None:
        raise InputError(
            f"--start open: expected a method made of parts, got the whole method {resolved.recipe.whole.name!r}, "
            "which has no gates; use warm or anew"
        )
    return open_leap_recipe(resolved, wanted.key_epochs)


def _prepare(
    out: Path, facts: dict[str, Any], first: bytes | None, *, resume: bool, overwrite: bool
) -> None:
    """Make sure that ``out`` holds nothing else, or exactly this run; overwriting removes what such a run writes."""
    from gsstream.core.errors import OutputError
    from gsstream.engine.run.output import RUN_FILES, prepare_output
    from gsstream.trade.segments.drive import KEY_STREAMS
    from gsstream.trade.segments.plan import PLAN, write_plan

    begun = (out / PLAN).is_file()
    if resume and overwrite:
        raise OutputError("--resume continues the run in the output folder, --overwrite deletes it: give one of them")
    if begun and not resume and not overwrite:
        raise OutputError(
            f"the output folder {out} already holds a run in segments: continue it with --resume, replace it with "
            "--overwrite, or choose another --out"
        )
    if not resume:
        prepare_output(out, overwrite=overwrite)
        for folder in (*out.glob("key-[0-9]*"), *out.glob("segment-[0-9]*")) if begun else ():
            for name in RUN_FILES:
                (folder / name).unlink(missing_ok=True)
        (out / KEY_STREAMS).unlink(missing_ok=True)
    write_plan(out, facts, resume=resume)
    if first is not None:
        (out / KEY_STREAMS).write_bytes(first)


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
