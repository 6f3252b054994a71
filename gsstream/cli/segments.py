"""``gsstream run-segments``: a long recording in segments that are encoded at the same time."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import typer

from gsstream.cli.listing import plural, table
from gsstream.cli.streams import stream_file

if TYPE_CHECKING:
    from gsstream.engine.assemble import Assembly
    from gsstream.recipe.load import ResolvedRecipe
    from gsstream.source.base import FrameSource
    from gsstream.trade.segments.drive import SegmentsResult, Setting
    from gsstream.trade.segments.plan import SegmentPlan
    from gsstream.trade.sweep.executor import Executor


class SegmentStart(StrEnum):
    """Where the first frame of a later segment comes from."""

    warm = "warm"
    anew = "anew"


def run_segments(
    source: Annotated[str, typer.Option("--source", help="demo, synthetic:K=V&..., DIR, or LAYOUT:DIR.")],
    out: Annotated[Path, typer.Option("--out", help="Output folder; must not hold another run.")],
    segments: Annotated[int, typer.Option("--segments", min=1, help="Number of segments, of nearly equal length.")],
    method: Annotated[
        str | None, typer.Option("--method", help="Method (see 'gsstream methods'); by default the recipe file's.")
    ] = None,
    recipe: Annotated[
        list[Path] | None,
        typer.Option("--recipe", help="YAML file with differences from the method's recipe; repeatable, last wins."),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY.PATH=VALUE", help="Change a value, e.g. gate.temperature=0.3; repeatable."),
    ] = None,
    frames: Annotated[int | None, typer.Option("--frames", min=1, help="Number of frames; all by default.")] = None,
    scale: Annotated[float | None, typer.Option("--scale", help="Shrink images by this factor in (0, 1].")] = None,
    start: Annotated[
        SegmentStart,
        typer.Option(
            "--start",
            help="First frame of a later segment; warm: the scene of the segment before, carried over in one step; "
            "anew: reconstructed like frame 0.",
        ),
    ] = SegmentStart.warm,
    key_epochs: Annotated[
        int, typer.Option("--key-epochs", min=1, help="Epochs of the step that carries a scene from key to key frame.")
    ] = 20,
    first_frame: Annotated[
        Path | None,
        typer.Option("--first-frame", help="Take frame 0 over from this stream, do not reconstruct it."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option("--workers", min=1, help="Segments at a time; default: one for each processor.")
    ] = None,
    threads: Annotated[int, typer.Option("--threads", min=1, help="Threads of each worker.")] = 1,
    ray: Annotated[
        str | None,
        typer.Option("--ray", metavar="ADDRESS", help="Run on this Ray cluster (extra: ray); 'local' starts one here."),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the run that --out holds.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the run that --out holds.")] = False,
    no_video: Annotated[bool, typer.Option("--no-video", help="Write no video, only still pictures.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print only warnings and errors.")] = False,
) -> None:
    """Encode a recording in segments, several at a time, and join them into one stream.

    Each segment begins with a key packet, at which players can also join. A killed worker's segment goes on where it
    stopped; after Ctrl-C or a failure, --resume keeps what is finished.
    """
    overrides = [("--set", text) for text in settings or ()]
    overrides += [(f"--{key}", f"{key}={value}") for key, value in (("frames", frames), ("scale", scale)) if value]
    wanted = Wanted(source, out, segments, start.value, key_epochs, first_frame, workers, threads, ray)
    result = _encode(wanted, method, recipe or (), overrides, (resume, overwrite), (quiet, not no_video))
    if not quiet:
        typer.echo(_seams(result))


class Wanted(NamedTuple):
    """What was asked for besides the recipe."""

    source: str
    out: Path
    segments: int
    start: Literal["warm", "anew"]
    key_epochs: int
    first_frame: Path | None
    workers: int | None
    threads: int
    ray: str | None


def _encode(
    wanted: Wanted, method: str | None, recipe: Sequence[Path], overrides: Sequence[tuple[str, str]],
    again: tuple[bool, bool], shown: tuple[bool, bool],
) -> SegmentsResult:  # fmt: skip
    """``again``: resume, overwrite; ``shown``: quiet, video."""
    from gsstream.plugins.catalog import load_catalog
    from gsstream.recipe.load import resolve_recipe

    catalog = load_catalog()
    resolved = resolve_recipe(method, catalog.recipe_path, recipe, overrides)
    from gsstream.engine.assemble import assemble
    from gsstream.engine.recording import open_recording
    from gsstream.trade.gallery import SUMMARY, write_gallery
    from gsstream.trade.segments.drive import run_segments as drive
    from gsstream.trade.segments.join import first_frame_of
    from gsstream.trade.sweep.drive import only_one

    assembly = assemble(resolved, catalog)
    first = None if wanted.first_frame is None else first_frame_of(stream_file(wanted.first_frame))
    recording = open_recording(wanted.source, assembly.recipe, catalog)
    out, (quiet, video) = wanted.out, shown
    try:
        work = _work(wanted, first, resolved, assembly, recording)
        out.mkdir(parents=True, exist_ok=True)
        with only_one(out, "run"):
            _prepare(out, work.facts, first, resume=again[0], overwrite=again[1])
            say = (lambda _: None) if quiet else typer.echo
            result = drive(work.plan, work.setting, out, _executor(wanted), say=say)
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
    setting = Setting(uri, resolved, _carrying(resolved, assembly, wanted.key_epochs), wanted.ray is None)
    facts = {
        "source": uri, "segments": wanted.segments, "frames": total, "start": wanted.start,
        "key_epochs": wanted.key_epochs, "recipe": recipe_hash(assembly.recipe),
        "first_frame": None if first is None else f"{zlib.crc32(first):08x}",
    }  # fmt: skip
    return SegmentWork(plan, setting, facts)


def _carrying(resolved: ResolvedRecipe, assembly: Assembly, epochs: int) -> ResolvedRecipe:
    """The recipe with the epochs of a leap, where the method reads them."""
    from gsstream.recipe.load import ResolvedRecipe

    if assembly.whole is not None and "stream.epochs" not in assembly.whole.heeds:
        return resolved
    stream = resolved.recipe.stream.model_copy(update={"epochs": epochs})
    return ResolvedRecipe(resolved.recipe.model_copy(update={"stream": stream}), resolved.origins)


def _prepare(
    out: Path, facts: dict[str, Any], first: bytes | None, *, resume: bool, overwrite: bool
) -> None:
    """Make sure that ``out`` holds nothing else, or exactly this run; overwriting removes what such a run writes."""
    from gsstream.core.errors import OutputError
    from gsstream.engine.output import RUN_FILES, prepare_output
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


def _executor(wanted: Wanted) -> Executor:
    from gsstream.trade.segments.job import run_segment
    from gsstream.trade.sweep.executor import LocalExecutor, usable_processors

    if wanted.ray is not None:
        from gsstream.trade.sweep.ray_executor import RayExecutor

        return RayExecutor(wanted.ray, wanted.workers, wanted.threads, run_segment)
    count = wanted.workers or max(1, usable_processors() // wanted.threads)
    return LocalExecutor(count, wanted.threads, run_segment, ["gsstream.trade.sweep.warm"])


def _seams(result: SegmentsResult) -> str:
    """The seams as a table."""
    rows = [
        [str(s.frame), f"{s.key_bytes / 1000:.1f}", f"{s.delta_bytes / 1000:.1f}", *map(_db, (s.before, s.at, s.after))]
        for s in result.seams
    ]
    made = f"{plural(result.made, 'task')} made, {result.kept} kept"
    if not rows:
        return made
    heading = ("SEAM", "KEY KB", "DELTA KB", "PSNR BEFORE", "AT", "AFTER")
    return f"{table(heading, rows)}\n{made}"


def _db(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
