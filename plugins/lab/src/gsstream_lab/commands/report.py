"""``gsstream report``: a sweep's table as a page and as Markdown."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gsstream.cli.listing import plural
from gsstream.core.errors import UnknownName


def report(
    folder: Annotated[Path, typer.Argument(help="Output folder of 'gsstream sweep'.")],
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder to write to; default: report/ in that folder.")
    ] = None,
    data: Annotated[
        Path | None, typer.Option("--data", help="Folder of the recordings, as for 'gsstream sweep'; for the pictures.")
    ] = None,
    sheets: Annotated[
        str,
        typer.Option(
            "--sheets",
            metavar="SCENES|none",
            help="Scenes to show pictures of, comma-separated. They hold images of the recording: mind its licence.",
        ),
    ] = "none",
    add: Annotated[
        list[str] | None,
        typer.Option(
            "--add",
            metavar="[NAME=]FILE",
            help="What 'evaluate --json' or 'evaluate-files --json' wrote, to stand beside the runs; repeatable.",
        ),
    ] = None,
) -> None:
    """Write report.html (one file, no network), report.md and its figures.

    Pareto fronts, what each knob buys, all recipes with their spread over seeds, curves over frames; the paper's
    numbers beside ours where the sweep names a table of it. Everything is computed from the table.
    """
    from gsstream.core.install_hints import require_encoder
    from gsstream_lab.report.added import beside, read_added
    from gsstream_lab.report.groups import read_sweep_data

    require_encoder()
    swept = read_sweep_data(folder)
    others = beside(swept, [read_added(text) for text in add or ()])
    wanted = [] if sheets == "none" else [name.strip() for name in sheets.split(",") if name.strip()]
    for name in wanted:
        if name not in swept.scenes:
            raise UnknownName("scene with a finished run", name, swept.scenes)
    # The slow imports come last, so that a mistake on the command line is answered at once.
    from gsstream_lab.report.build import build_report
    from gsstream_lab.report.document import write_report
    from gsstream_lab.report.pictures import contact_sheet, recording_of

    shown = {}
    for name in wanted:
        with recording_of(swept, name, data) as source:
            shown[name] = contact_sheet(folder, swept, name, source)
    title = f"Sweep {swept.config['name']}"
    written = write_report(title, [*build_report(swept, shown), *others], out or folder / "report")
    typer.echo("\n".join(f"wrote {path}" for path in written[:2]))
    if swept.missing or swept.failed:
        typer.echo(f"{plural(len(swept.missing), 'cell')} not run yet, {len(swept.failed)} failed", err=True)
