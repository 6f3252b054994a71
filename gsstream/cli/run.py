"""``gsstream run``: a recording in, a stream and its measurements out."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gsstream.cli import options
from gsstream.cli.streams import stream_file

if TYPE_CHECKING:
    from gsstream.engine.run.session import RunResult
    from gsstream.serve.server import Server
    from gsstream.source.base import FrameSource


def run(
    source: Annotated[str, typer.Option("--source", help="demo, synthetic:K=V&..., watch:DIR, DIR, or LAYOUT:DIR.")],
    out: options.Out,
    method: options.Method = None,
    recipe: options.Recipes = None,
    settings: options.Settings = None,
    budget: Annotated[str | None, options.BUDGET] = None,
    frames: options.Frames = None,
    scale: options.Scale = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Seed of every random stream.")] = None,
    renderer: Annotated[str | None, typer.Option("--renderer", help="Renderer: auto, cpu, reference, ...")] = None,
    first_frame: options.FirstFrame = None,
    resume: options.Resume = False,
    overwrite: options.Overwrite = False,
    checks: Annotated[str | None, typer.Option("--checks", help="Look at parts: off, frame (default), step.")] = None,
    no_video: options.NoVideo = False,
    quiet: options.Quiet = False,
    serve: Annotated[
        int | None,
        typer.Option(
            "--serve", metavar="PORT", min=0, max=65535, help="Show the frames live at this port (extra: serve)."
        ),
    ] = None,
) -> None:
    """Encode a recording as a stream of 3D Gaussians.

    The recipe of the run is the method's, changed by --recipe FILE, then by --set and the short options. Ctrl-C ends
    after the current frame with a valid stream (exit code 130), SIGTERM does so too (143); --resume continues it to the
    same bytes.
    """
    from gsstream.engine.run.output import claim_output, disk_errors, ended_by_signals
    from gsstream.plugins.catalog import load_catalog
    from gsstream.recipe.load import resolve_recipe

    changes = options.overrides(settings, budget=budget, frames=frames, scale=scale, seed=seed, renderer=renderer)
    catalog = load_catalog()
    resolved = resolve_recipe(method, catalog.recipe_path, recipe or (), changes)
    # Before the folder is touched: a port in use must not cost the run that it holds.
    server = _server(out, serve)
    # The slow imports come last: a mistake on the command line is answered at once.
    from gsstream.engine.assembly.assemble import assemble
    from gsstream.engine.run.recording import open_recording, read_first_frame
    from gsstream.engine.run.session import run as run_session

    assembly = assemble(resolved, catalog, checks)
    # Read before the folder is touched: --overwrite must not delete a run for the sake of a faulty recording.
    first = None if first_frame is None else read_first_frame(stream_file(first_frame))
    recording = open_recording(source, assembly.recipe, catalog)
    try:
        with (
            claim_output(out, resume=resume, overwrite=overwrite), disk_errors(out), ended_by_signals() as came,
            _serving(server),
        ):  # fmt: skip
            result = run_session(assembly, recording, out, resume=resume, quiet=quiet, first_frame=first)
            _pictures(result, recording, not no_video, quiet, assembly.recipe.renderer.name == "reference")
    finally:
        recording.close()
    if result.interrupted:
        raise typer.Exit(128 + came[0] if came else 130)


def _server(out: Path, port: int | None) -> Server | None:
    """The server of ``--serve``, with its address taken: it shows what the run writes, on this machine alone."""
    if port is None:
        return None
    from gsstream.cli.serve import TOKEN
    from gsstream.serve.server import Server

    return Server(out / "stream.gss", live=True, port=port, token=os.environ.get(TOKEN) or None)


@contextmanager
def _serving(server: Server | None) -> Iterator[None]:
    if server is None:
        yield
        return
    with server:
        typer.echo(f"live at {server.url}")
        yield


def _pictures(result: RunResult, recording: FrameSource, video: bool, quiet: bool, warned: bool) -> None:
    """Contact sheet, plots, summary and video of what was written, and where to find them.

    ``warned``: the run has said already that nothing fast renders here; the player need not say it again.
    """
    from gsstream.player.render import SlowRendererWarning
    from gsstream.trade.show.gallery import SUMMARY, write_gallery

    if result.frames == 0:
        return
    with warnings.catch_warnings():
        if warned:
            warnings.simplefilter("ignore", SlowRendererWarning)
        written = write_gallery(result.out, recording, video=video)
    if not quiet:
        typer.echo((result.out / SUMMARY).read_text(encoding="utf-8").rstrip())
        typer.echo("\n".join(f"wrote {path}" for path in (result.out / "stream.gss", *written)))
        if result.interrupted:
            typer.echo(f"stopped after frame {result.frames - 1}; continue with --resume")
