"""``gsstream search``: settings for a recording, from short runs measured on held-out cameras."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from gsstream.cli import options
from gsstream.cli.grouped import grouped
from gsstream.core.errors import InputError
from gsstream_lab.commands.options import RecordingOptions, WorkerOptions, progress

FOUND = "found.yaml"


@grouped
def search(
    recording: RecordingOptions,
    method: Annotated[str, typer.Option("--method", help="Method whose settings are looked for.")],
    out: Annotated[Path, typer.Option("--out", help="Folder of the runs and of found.yaml; a search there goes on.")],
    where: WorkerOptions,
    tried: Annotated[
        list[str] | None,
        typer.Option(
            "--try",
            metavar="KEY=A,B,...",
            help="Values of a recipe key; repeatable; by default degree of harmonics "
            "and, for an octree, its root, levels and base.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of every random stream.")] = 0,
    quiet: options.Quiet = False,
) -> None:
    """Look for settings of a recording and write the recipe as found.yaml.

    One key after the other takes the value with the highest PSNR on training cameras that are left out (the tuning
    split), while that gains more than 0.05 dB; again from the first key until none moves. Test cameras have no say. One
    frame (the default here) only frame 0 is compared; with --frames 5 or so the frames after it are.
    """
    from gsstream.core.install_hints import require_encoder
    from gsstream.discovery.catalog import load_catalog
    from gsstream.engine.assembly.assemble import assemble
    from gsstream.recipe.load import resolve_recipe
    from gsstream_lab.sweep.check import check_parts
    from gsstream_lab.sweep.plan import make_plan
    from gsstream_lab.sweep.search import SweepScore, climb, usual_ladders, value_of
    from gsstream_lab.sweep.tune import tuned_recipe

    require_encoder()
    catalog = load_catalog()
    files = [] if recording.recipe is None else [recording.recipe]
    resolved = resolve_recipe(method, catalog.recipe_path, files, options.overrides(recording.settings))
    parts = assemble(resolved, catalog).resolved
    ladders = _ladders(tried) or usual_ladders(parts.recipe)
    start = {key: value_of(parts, key) for key in ladders}
    ladders = {key: values if start[key] in values else (start[key], *values) for key, values in ladders.items()}
    score = SweepScore(
        scene=recording.scene(1),
        method=method,
        seed=seed,
        out=out,
        find_method=catalog.recipe_path,
        executor=where.executor,
        say=progress(quiet),
    )
    for key, values in ladders.items():
        check_parts(make_plan(score.config(start, key, values), Path(), catalog.recipe_path), catalog)
    found = climb(start, ladders, score)
    key = next(iter(ladders))
    (point,) = make_plan(score.config(found, key, [found[key]]), Path(), catalog.recipe_path).points
    (out / FOUND).write_text(tuned_recipe(point.resolved), encoding="utf-8")
    typer.echo("\n".join(f"{key}: {start[key]} -> {value}" for key, value in found.items()))
    typer.echo(f"\nwrote {out / FOUND}; next: {recording.next_command(out / FOUND, out / 'run')}")


def _ladders(tried: list[str] | None) -> dict[str, tuple[Any, ...]]:
    """Key -> values of --try. Raises RecipeError or InputError."""
    from gsstream.recipe.document import read_override

    out: dict[str, tuple[Any, ...]] = {}
    for text in tried or ():
        key, _, values = text.partition("=")
        found = tuple(read_override(f"{key}={value}")[1].value for value in values.split(","))
        if len({str(value) for value in found}) < max(2, len(found)):
            raise InputError(f"--try {text}: expected two different values or more, such as first_frame.sh_degree=1,2")
        out[key] = found
    return out
