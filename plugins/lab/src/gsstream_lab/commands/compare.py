"""``gsstream compare``: methods on one recording from one frame 0, on one page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer

from gsstream.cli import options
from gsstream.cli.grouped import grouped
from gsstream.cli.listing import plural
from gsstream.core.errors import InputError
from gsstream_lab.commands.options import RecordingOptions, WorkerOptions, progress


@dataclass(frozen=True)
class Equal:
    """What every method gets the same of."""

    at: Annotated[
        Literal["own", "epochs", "time"],
        typer.Option(
            "--at",
            help="own: the settings of each recipe; epochs: the same passes a frame; time: the same processor "
            "time, by passes in proportion to what a run at own settings took.",
        ),
    ] = "own"
    epochs: Annotated[
        str | None,
        typer.Option("--epochs", metavar="N,...", help="With --at epochs; several give curves; default: the first's."),
    ] = None
    seconds: Annotated[
        str | None,
        typer.Option("--seconds", metavar="S,...", help="With --at time, a frame; default: what the first takes."),
    ] = None

    def numbers(self) -> tuple[list[int], list[float]]:
        """Parse --epochs and --seconds to lists of numbers. Raises InputError for an option without meaning here."""
        for option, text, where in (("--epochs", self.epochs, "epochs"), ("--seconds", self.seconds, "time")):
            if text is not None and self.at != where:
                raise InputError(f"{option} {text} belongs to --at {where}, got --at {self.at}")
        return _integers(self.epochs, "--epochs", 1), _numbers(self.seconds, "--seconds", 1e-3)


@grouped
def compare(
    methods: Annotated[str, typer.Argument(help="Methods or recipe files, comma-separated; the first makes frame 0.")],
    out: Annotated[Path, typer.Option("--out", help="Folder of streams, table and page; one there is continued.")],
    recording: RecordingOptions,
    equal: Equal,
    where: WorkerOptions,
    seeds: Annotated[str, typer.Option("--seeds", metavar="N,...", help="Seeds of every random stream.")] = "0",
    split: Annotated[
        Literal["reporting", "tuning"], typer.Option("--split", help="Which cameras test, as data.split.")
    ] = "reporting",
    pictures: Annotated[
        bool, typer.Option("--pictures/--no-pictures", help="Pictures hold images of the recording: mind its licence.")
    ] = True,
    quiet: options.Quiet = False,
) -> None:
    """Encode one recording with several methods and show them side by side.

    All begin with one frame 0; report.html and report.md are written.
    The report of the sweep, and pictures side by side from a held-out camera, and a video of all methods. Finished runs
    are kept: the same command goes on, and more methods may join. A run that fails is recorded and the others go on
    (exit code 1 at the end).
    """
    from gsstream.core.install_hints import require_encoder
    from gsstream.discovery.catalog import load_catalog
    from gsstream_lab.report.groups import read_sweep_data
    from gsstream_lab.sweep.check import check_parts
    from gsstream_lab.sweep.compare import equal_epochs, equal_time, own_settings
    from gsstream_lab.sweep.drive import run_sweep
    from gsstream_lab.sweep.plan import make_plan

    require_encoder()
    epochs, seconds = equal.numbers()
    names = [name.strip() for name in methods.split(",") if name.strip()]
    catalog, config = load_catalog(), own_settings(names, recording.scene(), _integers(seeds, "--seeds", 0), split)
    if equal.at == "epochs":
        config = equal_epochs(config, epochs, catalog)
    plan = make_plan(config, Path(), catalog.recipe_path)
    check_parts(plan, catalog)
    result = run_sweep(plan, out, where.executor(), say=progress(quiet))
    if equal.at == "time":
        took = {one.variant: one.mean("cpu_seconds") for one in read_sweep_data(out).groups}
        plan = make_plan(equal_time(config, seconds, took, catalog), Path(), catalog.recipe_path)
        result = run_sweep(plan, out, where.executor(), say=progress(quiet))
    _write_page(out, pictures, quiet)
    if result.failed:
        typer.echo(f"{plural(len(result.failed), 'run')} failed; the page says why", err=True)
        raise typer.Exit(1)


def _numbers(text: str | None, option: str, least: float, kind: type = float) -> list[float]:
    try:
        found = [] if text is None else [kind(part) for part in text.split(",")]
    except ValueError:
        found = [-1]
    if found and (not least <= min(found) <= max(found) < float("inf") or len(set(found)) < len(found)):
        raise InputError(
            f"{option} {text}: expected different {'whole ' if kind is int else ''}numbers from {least:g} on, such as "
            "3,6,12"
        )
    return found


def _integers(text: str | None, option: str, least: int) -> list[int]:
    return [int(number) for number in _numbers(text, option, least, int)]


def _write_page(out: Path, pictures: bool, quiet: bool) -> None:
    from gsstream_lab.report.build import build_report
    from gsstream_lab.report.document import Block, write_report
    from gsstream_lab.report.groups import read_sweep_data
    from gsstream_lab.report.pictures import decoding, recording_of, side_by_side

    data = read_sweep_data(out)
    (scene,) = data.scenes
    shown: list[Block] = [decoding(out, data, scene)]
    if pictures:
        with recording_of(data, scene, None) as source:
            shown += side_by_side(out, data, scene, source) if len(source.info.test) else []
    written = write_report(f"Methods side by side: {scene}", build_report(data, {scene: shown}), out)
    if not quiet:
        typer.echo("\n".join(f"wrote {path}" for path in written[:2]))
