"""Numbers of the results pages: from tables of sweeps to docs/results/data, and from there into the pages.

    python -m tools.results take protocol runs/protocol --commit 5027d420
    python -m tools.results fill [--check]

The first writes the numbers of every finished run of a sweep to ``docs/results/data/protocol.jsonl``, one run a line.
The second fills in every table of a page that says where its rows are, between two comments:

    <!-- rows of protocol, protocol-peers: psnr_first psnr kb -->
    <!-- end of rows -->

Rows of one name are runs with different seeds, of which mean and standard deviation are shown. With ``--check`` nothing
is written, and a page that differs from its data is named (exit code 1).
"""

from __future__ import annotations

import argparse
import json
import math
import re
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gsstream_lab.report.groups import read_sweep_data
from gsstream_lab.report.quantities import BY_KEY, cell, spread

from gsstream.core.errors import InputError
from gsstream.evaluation.summary import format_table

PAGES = Path(__file__).parents[1] / "docs" / "results"
TABLE = re.compile(r"<!-- rows of (?P<files>[\w, -]+?): (?P<keys>[\w ]+?) -->\n(?P<rows>.*?)<!-- end of rows -->", re.S)

Row = dict[str, Any]


def rows_of_sweep(folder: Path, commit: str) -> list[Row]:
    """Return the numbers of a sweep's finished runs, and where they come from. Raises InputError without any."""
    data = read_sweep_data(folder)
    rows = []
    for group in data.groups:
        for run in group.runs:
            values = {key: float(f"{value:.6g}") for key, value in run.values.items() if math.isfinite(value)}
            facts = data.table.machines[run.row["machine"]]["facts"]
            origin = {"commit": commit, "recipe": run.row["recipe"], "date": run.row["date"]}
            machine = {"processor": facts["processor"], "processors": facts["processors_usable"]}
            frames = len(run.row["frames"])
            rows.append({"scene": group.scene, "name": group.label, "seed": run.seed, "frames": frames, **values,
                         **origin, **machine})  # fmt: skip
    return rows


def read_rows(name: str, folder: Path) -> list[Row]:
    """Return the rows of a data file. Raises InputError when it is not there."""
    path = folder / "data" / f"{name}.jsonl"
    if not path.is_file():
        raise InputError(f"{path}: found no file; 'python -m tools.results take {name} SWEEP' writes its rows")
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def table_of(rows: Sequence[Row], keys: Sequence[str]) -> str:
    """Return a Markdown table with a line for each scene, name and number of frames, in the order of the rows."""
    lines: dict[tuple[str, str, int], list[Row]] = {}
    for row in rows:
        lines.setdefault((row["scene"], row["name"], row["frames"]), []).append(row)
    scenes = len({scene for scene, _, _ in lines}) > 1
    table = [["run", *(["recording"] if scenes else []), "frames", "seeds", *(BY_KEY[key].title for key in keys)]]
    for (scene, name, frames), runs in lines.items():
        cells = []
        for key in keys:
            values = [run.get(key, math.nan) for run in runs]
            cells.append(cell(key, statistics.fmean(values), spread(values)))
        table.append([f"`{name}`", *([scene] if scenes else []), str(frames), str(len(runs)), *cells])
    return format_table(table)


def filled(text: str, folder: Path) -> str:
    """Return a page with every table made from its data. Raises InputError for rows or quantities it does not know."""

    def made(found: re.Match[str]) -> str:
        files, keys = [name.strip() for name in found["files"].split(",")], found["keys"].split()
        unknown = [key for key in keys if key not in BY_KEY]
        if unknown:
            raise InputError(f"rows of {found['files']}: unknown quantities {unknown}; known: {', '.join(BY_KEY)}")
        rows = [row for name in files for row in read_rows(name, folder)]
        head = found[0].split("\n", 1)[0]
        return f"{head}\n{table_of(rows, keys)}\n<!-- end of rows -->"

    return TABLE.sub(made, text)


def fill(folder: Path, check: bool) -> list[Path]:
    """Fill in all pages of a folder, or only look; return those that differed."""
    differ = []
    for page in sorted(folder.glob("*.md")):
        text = page.read_text(encoding="utf-8")
        now = filled(text, folder)
        if now != text:
            differ.append(page)
            if not check:
                page.write_text(now, encoding="utf-8")
    return differ


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one of the two commands; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.results", description=__doc__.split("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    take = commands.add_parser("take", help="write the numbers of a finished sweep to docs/results/data")
    take.add_argument("name")
    take.add_argument("sweep", type=Path)
    take.add_argument("--commit", required=True, help="of the code that ran")
    pages = commands.add_parser("fill", help="make the tables of the pages from the data")
    pages.add_argument("--check", action="store_true", help="only say which pages differ")
    given = parser.parse_args(arguments)
    if given.command == "take":
        rows = rows_of_sweep(given.sweep, given.commit)
        path = PAGES / "data" / f"{given.name}.jsonl"
        path.parent.mkdir(exist_ok=True)
        path.write_text("".join(f"{json.dumps(row)}\n" for row in rows), encoding="utf-8")
        print(f"{len(rows)} runs in {path}")
        return 0
    differ = fill(PAGES, given.check)
    for page in differ:
        print(f"{page.name} {'differs from its data' if given.check else 'made from its data'}")
    return 1 if given.check and differ else 0


if __name__ == "__main__":
    raise SystemExit(main())
