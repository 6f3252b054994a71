"""``gsstream compare``: methods on one recording from one frame 0, on one page."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gsstream.cli import options
from gsstream.cli.grouped import grouped
from gsstream.cli.listing import plural
from gsstream_lab.commands.options import RecordingOptions, WorkerOptions

if TYPE_CHECKING:
    from gsstream.plugins.catalog import Catalog
    from gsstream_lab.compare.plan import Wanted
    from gsstream_lab.jobs.base import Executor
    from gsstream_lab.sweep.config import SweepConfig


class At(StrEnum):
    """What is equal between the methods."""

    own = "own"
    epochs = "epochs"
    time = "time"


class Split(StrEnum):
    """Which cameras judge."""

    reporting = "reporting"
    tuning = "tuning"


@dataclass(frozen=True)
class Equal:
    """What every method gets the same of."""

    at: Annotated[
        At,
        typer.Option(
            "--at", help="own: the settings of each recipe; epochs: the same passes a frame; time: the same processor "
            "time, by passes in proportion to what a run at own settings took.",
        ),
    ] = At.own
    epochs: Annotated[
        str | None,
        typer.Option("--epochs", metavar="N,...", help="With --at epochs; several give curves; default: the first's."),
    ] = None
    seconds: Annotated[
        str | None,
        typer.Option("--seconds", metavar="S,...", help="With --at time, a frame; default: what the first takes."),
    ] = None


@grouped
def compare(
    methods: Annotated[str, typer.Argument(help="Methods or recipe files, comma-separated; the first makes frame 0.")],
    out: Annotated[Path, typer.Option("--out", help="Folder of streams, table and page; one there is continued.")],
    recording: RecordingOptions,
    equal: Equal,
    where: WorkerOptions,
    seeds: Annotated[str, typer.Option("--seeds", metavar="N,...", help="Seeds of every random stream.")] = "0",
    split: Annotated[Split, typer.Option("--split", help="Which cameras judge, as data.split.")] = Split.reporting,
    pictures: Annotated[
        bool, typer.Option("--pictures/--no-pictures", help="Pictures hold images of the recording: mind its licence.")
    ] = True,
    quiet: options.Quiet = False,
) -> None:
    """Encode one recording with several methods and show them side by side.

    All begin with one frame 0; report.html and report.md are written.
    Curves of quality on changed pixels and on the whole image against KB and seconds, all numbers, pictures side by
    side from a held-out camera, and a video of all methods. Finished runs are kept: the same command goes on, and more
    methods may join. A run that fails is recorded and the others go on (exit code 1 at the end).
    """
    from gsstream.plugins.catalog import load_catalog
    from gsstream_lab.compare.plan import Wanted
    from gsstream_lab.jobs.executor import make_executor
    from gsstream_lab.sweep.job import run_job

    wanted = Wanted(
        tuple(name.strip() for name in methods.split(",") if name.strip()), recording.source, recording.recipe,
        recording.frames, recording.scale, tuple(int(seed) for seed in _numbers(seeds, "--seeds", 0, whole=True)),
        recording.changes(), split.value,
    )  # fmt: skip
    catalog, limits = load_catalog(), _limits(equal.at, equal.epochs, equal.seconds)
    executor = functools.partial(make_executor, run_job, where.workers, where.threads, where.ray)
    failed = _run(wanted, equal.at, limits, out, catalog, executor, quiet)
    _write_page(out, recording.source, catalog, pictures, quiet)
    if failed:
        typer.echo(f"{plural(failed, 'run')} failed; the page says why", err=True)
        raise typer.Exit(1)


def _run(
    wanted: Wanted, at: At, limits: list[float], out: Path, catalog: Catalog, executor: Callable[[], Executor],
    quiet: bool,
) -> int:  # fmt: skip
    """Make every run that is not there yet; returns the number of those that failed."""
    from gsstream_lab.compare.plan import own
    from gsstream_lab.sweep.drive import run_sweep
    from gsstream_lab.sweep.plan import make_plan

    say = (lambda _: None) if quiet else typer.echo

    def made(config: SweepConfig) -> int:
        return len(run_sweep(make_plan(config, Path(), catalog.recipe_path), out, executor(), say=say).failed)

    if at is At.epochs:
        return made(_at_epochs(wanted, [int(number) for number in limits], catalog))
    failed = made(own(wanted))
    return made(_at_time(wanted, limits, out, catalog)) if at is At.time else failed


def _limits(at: At, epochs: str | None, seconds: str | None) -> list[float]:
    """What --epochs or --seconds says; nothing given: empty. Raises InputError for one that means nothing here."""
    from gsstream.core.errors import InputError

    for option, text, where in (("--epochs", epochs, At.epochs), ("--seconds", seconds, At.time)):
        if text is not None and at is not where:
            raise InputError(f"{option} {text} belongs to --at {where.value}, got --at {at.value}")
    if epochs is not None:
        return _numbers(epochs, "--epochs", 1, whole=True)
    return [] if seconds is None else _numbers(seconds, "--seconds", 1e-3)


def _numbers(text: str, option: str, least: float, whole: bool = False) -> list[float]:
    from gsstream.core.errors import InputError

    try:
        found = [float(int(part)) if whole else float(part) for part in text.split(",")]
    except ValueError:
        found = []
    if not found or not least <= min(found) <= max(found) < float("inf") or len(set(found)) < len(found):
        kind = "whole numbers" if whole else "numbers"
        raise InputError(f"{option} {text}: expected different {kind} from {least:g} on, such as 3,6,12")
    return found


def _at_epochs(wanted: Wanted, epochs: list[int], catalog: Catalog) -> SweepConfig:
    from gsstream_lab.compare.plan import equal_epochs, own_epochs

    known = [number for number in own_epochs(wanted, catalog).values() if number is not None]
    return equal_epochs(wanted, epochs or known[:1] or [1], catalog)


def _at_time(wanted: Wanted, seconds: list[float], out: Path, catalog: Catalog) -> SweepConfig:
    """The second half of --at time, once every method has run at its own settings."""
    from gsstream.core.errors import InputError
    from gsstream_lab.compare.plan import equal_time, own_epochs, own_seconds
    from gsstream_lab.report.groups import read_sweep_data

    measured = read_sweep_data(out)
    took = [own_seconds(measured, name) for name, number in own_epochs(wanted, catalog).items() if number is not None]
    known = [value for value in took if value > 0]
    if not seconds and not known:
        raise InputError("--at time: no method that makes passes over the cameras has run; say --seconds")
    return equal_time(wanted, seconds or known[:1], measured, catalog)


def _write_page(out: Path, source: str, catalog: Catalog, pictures: bool, quiet: bool) -> None:
    from gsstream.engine.run.recording import reopen_recording
    from gsstream_lab.compare.page import build_page
    from gsstream_lab.jobs.folder import recording_uri
    from gsstream_lab.report.document import write_report
    from gsstream_lab.report.groups import read_sweep_data

    data = read_sweep_data(out)
    recipe = data.table.recipes[data.groups[0].runs[0].row["recipe"]]["values"]
    recording = reopen_recording(recording_uri(source, None), recipe, catalog)
    try:
        with_pictures = pictures and len(recording.info.test) > 0
        blocks = build_page(out, data, recording if with_pictures else None)
    finally:
        recording.close()
    written = write_report(f"Methods side by side: {data.scenes[0]}", blocks, out)
    if not quiet:
        typer.echo("\n".join(f"wrote {path}" for path in written[:2]))
