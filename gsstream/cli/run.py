"""``gsstream run``: a recording in, a stream and its measurements out."""

from __future__ import annotations

import json
import re
import shlex
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gsstream.cli import options
from gsstream.cli.grouped import grouped
from gsstream.cli.listing import fitting
from gsstream.cli.open import server_beside, serving
from gsstream.cli.results import Results
from gsstream.cli.streams import stream_file
from gsstream.cli.working import working
from gsstream.core.errors import ComponentError, GsstreamError, OutputError, RecipeError, SourceError

if TYPE_CHECKING:
    from gsstream.discovery.catalog import Catalog
    from gsstream.engine.run.session import RunResult
    from gsstream.input.recordings.base import Source, SourceInfo
    from gsstream.recipe.model import Recipe

#: Methods that are recommended where none is named, best first.
SUGGESTED = ("s2gs-fast", "queen")


@grouped
def run(
    source: options.Source,
    out: options.Out,
    recipe: options.RecipeOptions,
    shown: options.ShownOptions,
    first_frame: options.FirstFrame = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the run that --out holds.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the run that --out holds.")] = False,
    serve: options.Serve = None,
) -> None:
    """Encode a recording as a stream of 3D Gaussians.

    The recipe is the method's, changed by --recipe, then --set and the short options. Ctrl-C (exit code 130) and
    SIGTERM (143) end after the current frame, before frame 0 is written at once; --resume goes on to the same bytes.
    """
    from gsstream.core.install_hints import require_encoder
    from gsstream.discovery.catalog import load_catalog
    from gsstream.engine.run.output import claim_output, disk_errors, ended_by_signals
    from gsstream.recipe.load import resolve_recipe

    require_encoder()
    catalog, results = load_catalog(), Results(out)
    resolved = resolve_recipe(recipe.method, catalog.recipe_path, recipe.recipe or (), recipe.overrides())
    folder, wanted, quiet = results.folder, shown.wanted(), shown.quiet
    server, say = server_beside(folder, serve), _silent if quiet else _note
    with working("loading the method", quiet) as display:
        # The slow imports come last: a mistake on the command line is answered at once.
        from gsstream.engine.assembly.assemble import assemble
        from gsstream.engine.run.recording import open_recording, read_first_frame
        from gsstream.engine.run.session import run as encode

        assembly = assemble(resolved, catalog)
        # Read before the folder is touched: --overwrite must not delete a run for the sake of a faulty recording.
        first = None if first_frame is None else read_first_frame(stream_file(first_frame))
        display.tell("opening the recording")
        recording = open_recording(source, assembly.recipe, catalog)
    try:
        say(assembly.note)
        _reused_lines(say, resolved.recipe, recording.info, given=recipe, catalog=catalog)
        _first_look(recording, source, quiet, again=resume)
        with (
            results.brought(resume=resume, overwrite=overwrite, say=say),
            claim_output(folder, resume=resume, overwrite=overwrite),
            ended_by_signals() as came,
            serving(server),
        ):
            try:
                with disk_errors(folder):
                    result = encode(assembly, recording, folder, resume=resume, quiet=quiet, first_frame=first)
            except GsstreamError as error:
                _what_there_is(error, folder, recording, wanted=wanted, quiet=quiet)
                raise
            except KeyboardInterrupt:
                raise typer.Exit(128 + came[0] if came else 130) from None
            with disk_errors(folder):
                _pictures(result, recording, wanted, quiet=quiet, warned=assembly.recipe.renderer.name == "reference")
    finally:
        recording.close()
    if result.interrupted:
        raise typer.Exit(128 + came[0] if came else 130)


def _note(line: str) -> None:
    """Print a note; print nothing for an empty note."""
    if line:
        typer.echo(f"note: {line}", err=True)


def _silent(_: str) -> None:
    pass


def _reused_lines(
    say: Callable[[str], None], recipe: Recipe, info: SourceInfo, *, given: options.RecipeOptions, catalog: Catalog
) -> None:
    """Print the defaults that were taken: method, recipe of the recording, frames, and that no camera is held out."""
    if not (given.method or given.recipe):
        better = next((name for name in SUGGESTED if ("method", name) in catalog.entries), None)
        advice = "" if better is None else f"; --method {better} makes far smaller packets"
        say(f"no --method given: taking {recipe.method!r}, in which everything may change{advice}")
    say(_proposed(info.uri, given.recipe or ()))
    if recipe.frames is not None and info.num_frames is not None and info.num_frames < recipe.frames:
        say(f"{recipe.frames} frames are wanted, the recording has {info.num_frames}: encoding {info.num_frames}")
    if len(info.test) == 0:
        some = f", e.g. --set {_held_out(info.train.ids[0])}" if len(info.train) > 2 else ""
        say(f"no camera is held out, so no quality is measured{some}")


def meant_for(uri: str) -> str | None:
    """Return the name of the recipe that is meant for a recording, by its layout; None where there is none.

    ``uri``: address of a recording that can be opened.
    """
    from gsstream.input.recordings.detect import LAYOUTS, detect
    from gsstream.recipe.shipped import OF_LAYOUT

    layout, colon, _ = uri.partition(":")
    if colon and layout in LAYOUTS:
        return OF_LAYOUT.get(layout)
    if uri == "demo" or not Path(uri).is_dir():
        return None
    try:
        return OF_LAYOUT.get(detect(Path(uri)))
    except SourceError:  # a folder of no layout, which has the name of another source by chance
        return None


def _proposed(source: str, given: Sequence[Path]) -> str:
    """Return a line that names the recipe made for a recording; empty where the command line gives this recipe."""
    from gsstream.recipe.shipped import SCHEME, recipe_file

    name = meant_for(source)
    if name is None or recipe_file(f"{SCHEME}{name}").resolve() in [recipe_file(path).resolve() for path in given]:
        return ""
    return (
        f"this recording has the layout of a published data set: --recipe {SCHEME}{name} sets its split, size "
        "and frames (nothing of it is applied unless you say so)"
    )


def _held_out(camera: str) -> str:
    """The setting that holds a camera out, quoted for a shell, and for YAML where its name has other signs."""
    name = camera if re.fullmatch(r"[\w.-]+", camera, re.ASCII) else json.dumps(camera)
    return shlex.quote(f"data.test_cameras=[{name}]")


def _first_look(recording: Source, uri: str, quiet: bool, *, again: bool) -> None:
    """Warn of poses that cannot be right before an hour is spent on them; not ``again`` when a run is resumed."""
    if again:
        return
    from gsstream.input.prepare.pose_checks import first_look

    with working("looking at frame 0", quiet):
        found = first_look(recording)
    for finding in found:
        warnings.warn(f"[{finding.code}] {finding.message}. All checks: gsstream scene validate {uri}", stacklevel=2)


def _what_there_is(error: GsstreamError, out: Path, recording: Source, wanted: Mapping[str, bool], quiet: bool) -> None:
    """Summary and pictures of a run that failed, as far as it came; the error learns how to go on."""
    from gsstream.engine.run.metrics_log import last_written
    from gsstream.engine.run.session import METRICS, RunResult

    if isinstance(error, RecipeError | OutputError):
        return  # nothing was done, or the folder takes no files: there is nothing to draw, or no place for it
    try:
        done = last_written(out / METRICS) + 1 if (out / METRICS).exists() else 0
        if done == 0:
            return
        _pictures(RunResult(out, done, False), recording, wanted, quiet=quiet, warned=True)
    except (GsstreamError, OSError) as trouble:
        error.add_note(f"its pictures could not be made: {trouble}")
        return
    pictures = " and pictures are" if wanted["pictures"] else " is"
    advice = ""
    if isinstance(error, SourceError):
        advice = "; with --set data.bad_image=repeat (or drop) as well, it passes over pictures that cannot be read"
    elif isinstance(error, ComponentError):
        advice = "; with --set stream.on_error=repeat as well, a frame that fails repeats the one before it"
    error.add_note(
        f"the stream in {out} is complete up to frame {done - 1}, and its summary{pictures} made. When the "
        f"cause is mended, the same command with --resume goes on{advice}"
    )


def _pictures(result: RunResult, recording: Source, wanted: Mapping[str, bool], quiet: bool, warned: bool) -> None:
    """Contact sheet, plots, summary and video; ``warned``: the run has printed that no fast renderer is installed."""
    from gsstream.evaluation.gallery import SUMMARY, write_gallery
    from gsstream.player.render import SlowRendererWarning

    if result.frames == 0:
        return
    with warnings.catch_warnings(), working("drawing pictures", quiet):
        if warned:
            warnings.simplefilter("ignore", SlowRendererWarning)
        written = write_gallery(result.out, recording, **wanted)
    if not quiet:
        typer.echo(fitting((result.out / SUMMARY).read_text(encoding="utf-8").rstrip()))
        typer.echo("\n".join(f"wrote {path}" for path in (result.out / "stream.gss", *written)))
        if result.interrupted:
            typer.echo(f"stopped after frame {result.frames - 1}; continue with --resume")
