"""``gsstream sweep``: many recipes on many scenes, into one table."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from gsstream.cli import options
from gsstream.cli.grouped import grouped
from gsstream.cli.listing import plural, table
from gsstream_lab.commands.options import WorkerOptions, progress

if TYPE_CHECKING:
    from gsstream_lab.sweep.plan import Plan


@grouped
def sweep(
    config: Annotated[Path, typer.Argument(help="YAML file that describes the sweep (docs/howto/sweep.md).")],
    out: Annotated[Path, typer.Option("--out", help="Folder of the table and streams; a sweep there is continued.")],
    where: WorkerOptions,
    scenes: Annotated[
        Path | None, typer.Option("--scenes", help="YAML file with 'scenes' that take the place of the sweep's own.")
    ] = None,
    data: Annotated[
        Path | None, typer.Option("--data", help="Folder of the recordings that the file names by relative paths.")
    ] = None,
    split: Annotated[
        Literal["tuning", "reporting"] | None,
        typer.Option("--split", help="Which cameras test: data.split of every cell; by default the file's."),
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Show what would run, and what is there already.")] = False,
    quiet: options.Quiet = False,
) -> None:
    """Run every recipe of a sweep on every scene with every seed.

    Cells that the table holds are kept; those that failed or were cut off are made again. A cell that fails is recorded
    and the others go on (exit code 1 at the end). Ctrl-C stops at once; the same command continues.
    """
    from gsstream.core.install_hints import require_encoder
    from gsstream.discovery.catalog import load_catalog
    from gsstream_lab.sweep.check import check_parts
    from gsstream_lab.sweep.config import read_sweep
    from gsstream_lab.sweep.plan import make_plan

    require_encoder()
    catalog = load_catalog()
    plan = make_plan(read_sweep(config, scenes, split), config.parent, catalog.recipe_path)
    check_parts(plan, catalog)
    if dry_run:
        typer.echo(_describe(plan, out))
        return
    from gsstream_lab.sweep.drive import run_sweep

    result = run_sweep(plan, out, where.executor(), data=data, say=progress(quiet))
    if not quiet:
        made = plural(result.made - len(result.failed), "cell")
        typer.echo(f"{out / 'table.jsonl'}: {made} made, {result.kept} kept; next: gsstream report {out}")
    if result.failed:
        typer.echo(f"{plural(len(result.failed), 'cell')} failed; the table holds the reasons:", err=True)
        for key, reason in result.failed.items():
            typer.echo(f"  {plan.cells[key].label}: {reason}", err=True)
        raise typer.Exit(1)


def _describe(plan: Plan, out: Path) -> str:
    """What a sweep would do, cell by cell."""
    from gsstream_lab.sweep.drive import first_frame_file
    from gsstream_lab.sweep.table import TABLE, TableData, read_table

    known = read_table(out) if (out / TABLE).is_file() else TableData()
    done = known.done()
    rows = []
    for cell in plan.cells.values():
        axes = " ".join(f"{key}={value}" for key, value in cell.axes.items())
        failed = known.cells.get(cell.id, {}).get("error")
        state = "kept" if cell.id in done else f"again, failed: {failed}" if failed else "to make"
        rows.append([cell.id, cell.scene.name, cell.variant, axes, str(cell.seed), plan.frame_0_of(cell), state])
    open_ = sum(row[-1] != "kept" for row in rows)
    firsts = sum(not first_frame_file(out, key).is_file() for key in plan.firsts)
    text = table(["cell", "scene", "variant", "axes", "seed", "frame 0 of", "state"], rows)
    return f"{text}\n\n{plural(len(rows), 'cell')}, {open_} to make; {plural(firsts, 'shared frame 0')} to make first"
