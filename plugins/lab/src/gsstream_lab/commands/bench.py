"""``gsstream bench``: how fast this machine renders and takes a frame step; JSON and a Markdown table."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from gsstream.cli import options
from gsstream.cli.grouped import grouped
from gsstream.core.errors import InputError

app = typer.Typer(
    help="Measure rendering or a frame step here.", rich_markup_mode=None, no_args_is_help=True, add_completion=False
)

Repetitions = Annotated[int, typer.Option("--repetitions", min=1, help="Rounds that count; each runs all cases.")]


@dataclass(frozen=True)
class BenchOptions:
    """What every benchmark can be told."""

    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the synthetic scene.")] = 0
    quick: Annotated[
        bool, typer.Option("--quick", help="A few seconds on tiny scenes: shows that it works, no more.")
    ] = False
    out: Annotated[Path | None, typer.Option("--out", help="Write all measurements to this JSON file.")] = None
    quiet: Annotated[bool, typer.Option("--quiet", help="Say nothing of the progress.")] = False


@app.command()
@grouped
def render(
    how: BenchOptions,
    sizes: Annotated[
        str, typer.Option("--sizes", help="Gaussians x width x height, comma-separated, e.g. 50000x320x240.")
    ] = "",
    shares: Annotated[str, typer.Option("--shares", help="Shares of tiles that are drawn, percent.")] = "100,25,5,2",
    threads: Annotated[str, typer.Option("--threads", help="Numbers of threads.")] = "1,2",
    renderers: Annotated[
        str, typer.Option("--renderers", help="Renderer parts, see 'gsstream plugins'.")
    ] = "cpu,reference",
    repetitions: Repetitions = 10,
) -> None:
    """Time forward and backward of renderers and compare them with the least time this machine could need.

    Sizes by default: 1k at 160x120 (also for the reference renderer, which is run there alone), then 20k, 50k, 100k and
    300k Gaussians at 320x240, 640x480 and 1352x1014: some minutes. The floor follows from counted work (Gaussians in
    view, live pixel pairs) and the multiply-add and copy peaks measured in the same run; it needs a renderer that can
    measure them. Close other programs first: their load is part of what is measured.
    """
    from gsstream.discovery.catalog import load_catalog

    _check(how.out)
    from gsstream_lab.bench.render import RenderPlan, bench_render
    from gsstream_lab.bench.tables import render_table

    plan = RenderPlan(
        sizes=_sizes(sizes, how.quick),
        shares=_percent("--shares", shares, least=0.01),
        threads=tuple(_integers("--threads", threads, least=1)),
        renderers=tuple(name.strip() for name in renderers.split(",") if name.strip()),
        repetitions=2 if how.quick else repetitions,
        warm_up=1 if how.quick else 2,
        seed=how.seed,
    )
    _report(bench_render(plan, load_catalog(), _progress(how.quiet)), render_table, how.out)


@app.command()
@grouped
def frame(
    how: BenchOptions,
    method: Annotated[str, typer.Option("--method", help="Method whose recipe is measured.")] = "s2gs-edge",
    settings: options.Settings = None,
    shares: Annotated[str, typer.Option("--shares", help="Shares of tiles that change, percent.")] = "100,25,5,2,0",
    static: Annotated[
        str, typer.Option("--static", help="Gaussians that stand still; shares are measured at the first number.")
    ] = "50000,100000,200000",
    moving: Annotated[int, typer.Option("--moving", min=1, help="Gaussians of the object that moves.")] = 2000,
    views: Annotated[int, typer.Option("--views", min=1, help="Training cameras.")] = 8,
    size: Annotated[str, typer.Option("--size", help="Image size, WIDTHxHEIGHT.")] = "320x240",
    repetitions: Repetitions = 3,
) -> None:
    """Time one frame step by phase on a synthetic scene.

    Two sweeps: the share of image tiles that change, and the size of the part that stands still while the same object
    moves. Three variants of the recipe: dense (every gate open, everything takes part), gated (its own gates), active
    (and only what changed beyond the noise takes part: stream.change_threshold, 4 where the recipe has none).
    """
    from gsstream.discovery.catalog import load_catalog
    from gsstream.recipe.load import resolve_recipe

    _check(how.out)
    catalog = load_catalog()
    changes = options.overrides(settings)
    if how.quick:
        changes.insert(0, ("--quick", "stream.epochs=1"))
    recipe = resolve_recipe(method, catalog.recipe_path, (), changes).recipe
    if recipe.streaming_method.name != "parts":
        raise InputError(
            f"--method {method}: expected a method made of parts, got the streaming_method "
            f"{recipe.streaming_method.name!r}; time it with gsstream run, which reports seconds per frame"
        )
    from gsstream_lab.bench.frame import FramePlan, bench_frame
    from gsstream_lab.bench.tables import frame_table

    width, height = _dimensions("--size", "80x60" if how.quick else size, 2)
    plan = FramePlan(
        recipe=recipe,
        shares=_percent("--shares", "25,0" if how.quick else shares, least=0),
        static=(400, 800) if how.quick else tuple(_integers("--static", static, least=1)),
        moving=100 if how.quick else moving,
        views=2 if how.quick else views,
        width=width,
        height=height,
        repetitions=1 if how.quick else repetitions,
        warm_up=0 if how.quick else 1,
        seed=how.seed,
    )
    _report(bench_frame(plan, catalog, _progress(how.quiet)), frame_table, how.out)


def _sizes(text: str, quick: bool) -> Any:
    from gsstream_lab.bench.render import Size

    if text:
        return tuple(Size(*_dimensions("--sizes", part, 3)) for part in text.split(","))
    if quick:
        return (Size(300, 64, 48),)
    images = ((320, 240), (640, 480), (1352, 1014))
    return (Size(1000, 160, 120), *(Size(n, *image) for n in (20_000, 50_000, 100_000, 300_000) for image in images))


def _dimensions(option: str, text: str, count: int) -> list[int]:
    wanted = "x".join(("GAUSSIANS", "WIDTH", "HEIGHT")[-count:])
    parts = text.strip().lower().split("x")
    if len(parts) != count:
        raise _wrong(option, wanted, text)
    return _integers(option, ",".join(parts), least=8)


def _integers(option: str, text: str, least: int) -> list[int]:
    try:
        values = [int(part) for part in text.split(",")]
    except ValueError as error:
        raise _wrong(option, f"integers >= {least}", text) from error
    if min(values) < least:
        raise _wrong(option, f"integers >= {least}", text)
    return values


def _percent(option: str, text: str, least: float) -> tuple[float, ...]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError as error:
        raise _wrong(option, f"percentages from {least:g} to 100", text) from error
    if not all(least <= value <= 100 for value in values):
        raise _wrong(option, f"percentages from {least:g} to 100", text)
    return tuple(value / 100 for value in values)


def _wrong(option: str, wanted: str, got: str) -> Exception:
    return InputError(f"{option}: expected {wanted}, got {got!r}")


def _check(out: Path | None) -> None:
    from gsstream_lab.bench.timing import check_writable

    if out is not None:
        check_writable(out)


def _report(data: Mapping[str, Any], table: Callable[[Mapping[str, Any]], str], out: Path | None) -> None:
    from gsstream_lab.bench.timing import write_json

    typer.echo(table(data))
    if out is not None:
        write_json(out, data)
        typer.echo(f"wrote {out}")


def _progress(quiet: bool) -> Callable[[str], None]:
    """One line that is written over on a terminal; nothing elsewhere."""
    if quiet or not sys.stderr.isatty():
        return lambda _: None

    def show(text: str) -> None:
        typer.echo(f"\r\x1b[K{text}", err=True, nl=False)

    return show
