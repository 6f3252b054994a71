"""``gsstream batch``: many recordings, one method, a stream for each at a place."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gsstream.cli import options
from gsstream.cli.grouped import grouped
from gsstream.cli.listing import plural
from gsstream_lab.commands.options import WorkerOptions, progress


@grouped
def batch(
    recordings: Annotated[Path, typer.Argument(metavar="LIST.yaml", help="The list (docs/howto/many.md).")],
    to: Annotated[str, typer.Option("--to", help="Folder, or s3://BUCKET/DIR, of the results.")],
    where: WorkerOptions,
    quiet: options.Quiet = False,
) -> None:
    """Encode every recording of a list with one method.

    A result is named by a digest of what it is made of, and its note is written last: what is there whole is kept, all
    else is made, so the same command goes on after whatever happened. A recording that fails is named and the others go
    on (exit code 1 at the end).
    """
    from gsstream.core.install_hints import require_encoder
    from gsstream.discovery.catalog import load_catalog
    from gsstream.store.place import place_at
    from gsstream_lab.batch.drive import run_batch
    from gsstream_lab.batch.plan import read_batch
    from gsstream_lab.batch.work import run_batch_job

    require_encoder()
    place = place_at(to)
    tasks = read_batch(recordings, load_catalog().recipe_path)
    result = run_batch(tasks, place, where.executor(run_batch_job), say=progress(quiet))
    if not quiet:
        typer.echo(f"{place.address}: {plural(result.made, 'stream')} made, {result.kept} kept")
    if result.failed:
        typer.echo(f"{plural(len(result.failed), 'recording')} failed; the same command tries them again:", err=True)
        for name, reason in result.failed.items():
            typer.echo(f"  {name}: {reason}", err=True)
        raise typer.Exit(1)
