"""``gsstream tune``: a recipe that fits a budget, from a short pilot."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gsstream.cli import options
from gsstream.cli.grouped import grouped
from gsstream.cli.listing import fitting, plural
from gsstream.cli.streams import stream_file
from gsstream_lab.commands.options import RecordingOptions, WorkerOptions, progress

if TYPE_CHECKING:
    from gsstream.recipe.budget import Budget
    from gsstream.recipe.model import Recipe
    from gsstream_lab.sweep.plan import Plan
    from gsstream_lab.sweep.tune import Trial


#: Frames of a pilot where none are given, the first one included.
FRAMES = 5


@grouped
def tune(
    recording: RecordingOptions,
    budget: Annotated[str, options.BUDGET],
    out: Annotated[Path, typer.Option("--out", help="Folder of the pilot and of tuned.yaml; a pilot there goes on.")],
    methods: Annotated[
        list[str] | None,
        typer.Option(
            "--method", metavar="METHOD", help="Method to try; repeatable; by default dense and the s2gs methods."
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of every random stream.")] = 0,
    first_frame: options.FirstFrame = None,
    workers: Annotated[
        int | None,
        typer.Option("--workers", min=1, help="Candidates at a time; default: one for each processor, 1 with a time."),
    ] = None,
    quiet: options.Quiet = False,
) -> None:
    """Try a few recipes on a few frames and write the best that fits a budget as tuned.yaml.

    Candidates are the methods as they are, with one knob changed for what is limited, and with the controller of
    'run --budget'. The best is the one with the highest PSNR on moving pixels of the test cameras: some of the
    training cameras (the tuning split); test cameras have no say. Nothing fits: the table says what came nearest,
    nothing is written, and the exit code is 1.
    """
    from gsstream.core.install_hints import require_encoder
    from gsstream.discovery.catalog import load_catalog
    from gsstream.recipe.budget import budget_overrides
    from gsstream.recipe.load import resolve_recipe
    from gsstream_lab.sweep.check import check_parts
    from gsstream_lab.sweep.plan import make_plan
    from gsstream_lab.sweep.tune import METHODS, give_first_frame, pilot

    require_encoder()
    catalog = load_catalog()
    limits = _limits(resolve_recipe(None, catalog.recipe_path, (), budget_overrides(budget)).recipe, recording.source)
    known = catalog.names("method")
    tried = methods or [name for name in METHODS if name in known]
    for name in tried:
        catalog.entry("method", name)
    plan = make_plan(pilot(recording.scene(FRAMES), tried, limits, seed), Path(), catalog.recipe_path)
    check_parts(plan, catalog)
    if first_frame is not None:
        give_first_frame(plan, out, stream_file(first_frame))
    trials = _run(plan, limits, out, workers=workers, quiet=quiet)
    _tell(plan, trials, limits, out=out, recording=recording)


def _limits(recipe: Recipe, source: str) -> Budget:
    """The budget, with a rate turned into the size of a packet of this recording."""
    from gsstream.discovery.catalog import load_catalog
    from gsstream.engine.run.recording import open_recording
    from gsstream.recipe.budget import sized
    from gsstream_lab.jobs.folder import recording_uri

    if recipe.budget.rate is None:
        return recipe.budget
    recording = open_recording(recording_uri(source, None), recipe, load_catalog())
    try:
        return sized(recipe.budget, recording.info.fps)
    finally:
        recording.close()


def _run(plan: Plan, limits: Budget, out: Path, workers: int | None, quiet: bool) -> list[Trial]:
    from gsstream.core.processors import processors
    from gsstream_lab.sweep.drive import run_sweep
    from gsstream_lab.sweep.table import read_table
    from gsstream_lab.sweep.tune import trial_of

    usable = processors()
    # Candidates that run at the same time would slow each other down.
    workers = workers or (1 if limits.time is not None else usable)
    run_sweep(plan, out, WorkerOptions(workers, max(1, usable // workers)).executor(), say=progress(quiet))
    rows = read_table(out).cells
    return [trial_of(point.variant, rows.get(point.id, {"status": "missing"}), limits) for point in plan.points]


def _tell(plan: Plan, trials: list[Trial], limits: Budget, out: Path, recording: RecordingOptions) -> None:
    from gsstream_lab.sweep.tune import choose, nearest, tune_table, tuned_recipe

    chosen = choose(trials)
    typer.echo(fitting(tune_table(trials, chosen)))
    if chosen is not None:
        resolved = next(point.resolved for point in plan.points if point.variant == chosen.name)
        file = out / "tuned.yaml"
        file.write_text(tuned_recipe(resolved), encoding="utf-8")
        typer.echo(f"\nwrote {file}: {chosen.name}; next: {recording.next_command(file, out / 'run')}")
        return
    close = nearest(trials)
    if close is None:
        typer.echo("\nno candidate could be run; the table says why", err=True)
        raise typer.Exit(1)
    worst = f"largest packet {max(close.sizes) / 1000:.2f} KB, longest frame {max(close.seconds):.2f} s"
    wanted = limits.model_dump(include={"time", "size", "memory"}, exclude_none=True)
    given = ", ".join(f"{name}={value:g}" for name, value in wanted.items())
    typer.echo(
        f"\nnothing fits {given} (seconds, bytes): nearest is {close.name} with {close.inside} of "
        f"{plural(close.frames, 'frame')} inside ({worst}, peak {close.memory / 1e6:.0f} MB); give more",
        err=True,
    )
    raise typer.Exit(1)
