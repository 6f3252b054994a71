"""Numbers of the results pages: from plans of sweeps to docs/results/data, and from there into the pages.

    python -m tools.results run --data DATA --out RUNS [NAME ...]
    python -m tools.results take NAME SWEEP --commit HASH [--at FRAME ...]
    python -m tools.results fill [--check]

The first runs the plans of ``configs/sweeps/results`` one after the other (or goes on with them), takes their numbers
and fills in the pages. The second takes the numbers of one sweep that ran elsewhere: one run a line, in the file
``NAME.jsonl`` of ``docs/results/data``; rows that the sweep does not hold stay as they are. With ``--at`` the PSNR, dB,
of what changed and is seen in each FRAME is taken, too, as ``frame_8``. The third fills in every table of a page
between two comments: of rows of files, of those with some names, or of a table of the paper:

    <!-- rows of protocol, protocol-long: psnr_first psnr kb -->
    <!-- rows of components, only 1-dense 5-hfp: psnr kb -->
    <!-- rows of paper-components: row psnr kb -->
    <!-- end of rows -->

and every number within a sentence: a quantity of a run, its difference or ratio to the same of another run, or the
BD-rate: by how many percent the bytes of a curve differ from another's at equal quality. A curve is the runs whose
names begin alike:

    <!-- protocol: comgs-l kb / s2gs-edge -->2.4<!-- end --> times the bytes
    <!-- curves: root psnr_changed % open -->-15<!-- end --> %

Rows of one name are runs with different seeds, of which mean and standard deviation are shown. With ``--check`` nothing
is written, and a page that differs from its data is named (exit code 1).
"""

from __future__ import annotations

import argparse
import json
import math
import re
import statistics
import subprocess
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from gsstream_lab.report.fronts import pareto_front
from gsstream_lab.report.groups import Run, read_sweep_data
from gsstream_lab.report.paper import paper_table
from gsstream_lab.report.quantities import BY_KEY, cell, spread
from gsstream_lab.report.rate_curves import bd_rate
from gsstream_lab.sweep.drive import cell_file

from gsstream.core.errors import InputError
from gsstream.evaluation.records import mean_of_views
from gsstream.evaluation.summary import format_table
from gsstream.play import Playback

ROOT = Path(__file__).parents[1]
PAGES, PLANS = ROOT / "docs" / "results", ROOT / "configs" / "sweeps" / "results"
#: The pages whose tables and numbers are made from the data.
FILLED = (*sorted(PAGES.glob("*.md")), ROOT / "docs" / "howto" / "choose-a-method.md")
TABLE = re.compile(
    r"<!-- rows of (?P<files>[\w, -]+?)(, only (?P<only>[^:]+))?: (?P<keys>[\w ]+?) -->\n"
    r"(?P<rows>.*?)<!-- end of rows -->",
    re.S,
)
NUMBER = re.compile(
    r"<!-- (?P<file>[\w-]+): (?P<name>\S+) (?P<key>\w+)( (?P<sign>[-/%]) (?P<other>\S+))? -->"
    r"(?P<value>[^<]*)<!-- end -->"
)

#: Begins the names of quantities of the camera that has least of them in the mean over frames.
WORST = "worst_"
#: Begins the names of the tables that the paper prints, which the lab has.
PRINTED = "paper-"

#: Plans of which a figure (tools/figures.py) shows the PSNR of every frame.
WITH_CURVES = frozenset({"protocol"})

Row = dict[str, Any]


def rows_of_sweep(folder: Path, commit: str, at: Sequence[int] = (), curve: bool = False) -> list[Row]:
    """Return the numbers of a sweep's finished runs, and where they come from. Raises InputError without any.

    ``at``: frames whose PSNR on what changed and is seen stands on its own. ``curve``: the PSNR of every
    frame stands as ``curve_psnr``.
    """
    data = read_sweep_data(folder)
    rows = []
    for group in data.groups:
        for run in group.runs:
            alone = {f"frame_{t}": mean_of_views([run.row["frames"][t]], "psnr_changed_seen") for t in at}
            found = {**run.values, **alone, **worst_camera(run, "psnr_changed_seen")}
            values = {key: float(f"{value:.6g}") for key, value in found.items() if math.isfinite(value)}
            facts = data.table.machines[run.row["machine"]]["facts"]
            origin = {"commit": commit, "recipe": run.row["recipe"], "date": run.row["date"]}
            machine = {"processor": facts["processor"], "processors": facts["processors_usable"]}
            frames = len(run.row["frames"])
            rows.append(
                {
                    "scene": group.scene,
                    "name": group.label,
                    "seed": run.seed,
                    "frame_0_of": run.row.get("frame_0_of", ""),
                    "frames": frames,
                    **values,
                    **_phases(run),
                    **_decoding(cell_file(folder, run.row["id"])),
                    **({"curve_psnr": _psnr_by_frame(run)} if curve else {}),
                    **origin,
                    **machine,
                }
            )
    return rows


def worst_camera(run: Run, name: str) -> dict[str, float]:
    """Return the least mean of a quantity over the frames after the first, of any test camera, if there are several."""
    by_camera: dict[str, list[float]] = {}
    for frame in run.row["frames"][1:]:
        for camera, value in (frame.get(name) or {}).items():
            if value is not None:
                by_camera.setdefault(camera, []).append(value)
    return {WORST + name: min(map(statistics.fmean, by_camera.values()))} if len(by_camera) > 1 else {}


def _phases(run: Run) -> dict[str, float]:
    """Return the mean wall milliseconds of every phase of the frames after the first, as ``ms_motion``."""
    later = [frame["seconds"] for frame in run.row["frames"][1:]]
    names = dict.fromkeys(name for seconds in later for name in seconds)
    means = {name: statistics.fmean(seconds.get(name, 0.0) for seconds in later) for name in names}
    return {f"ms_{name}": float(f"{1e3 * mean:.4g}") for name, mean in means.items()}


def _psnr_by_frame(run: Run) -> list[float]:
    return [round(mean_of_views([frame], "psnr"), 2) for frame in run.row["frames"]]


def _decoding(stream: Path) -> dict[str, float]:
    """Return the median wall milliseconds in which Python's player decodes a delta of a stream, as ``ms_decode``."""
    if not stream.is_file():
        return {}
    with Playback(stream) as frames:
        clock, taken = time.perf_counter(), list[float]()
        for _ in frames:
            taken.append(time.perf_counter() - clock)
            clock = time.perf_counter()
    return {"ms_decode": float(f"{1e3 * statistics.median(taken[1:]):.4g}")} if len(taken) > 1 else {}


def _which(row: Row) -> tuple[Any, ...]:
    return tuple(row.get(key) for key in ("scene", "name", "frames", "seed"))


def merged(before: Sequence[Row], now: Sequence[Row]) -> list[Row]:
    """Return the rows of both, in their order; a row that was taken before and is the same run keeps its commit."""
    known = {_which(row): row for row in before if "recipe" in row}  # the others were written by hand
    for row in now:
        old = known.get(_which(row))
        same = old is not None and old["date"] == row["date"]
        known[_which(row)] = {**row, "commit": old["commit"]} if old is not None and same else row
    return list(known.values())


def read_rows(name: str, folder: Path) -> list[Row]:
    """Return the rows of a data file, or of a table that the paper of S2GS prints. Raises InputError for others."""
    if name.startswith(PRINTED):
        return [{"row": row, **values} for row, values in paper_table(name.removeprefix(PRINTED)).rows.items()]
    path = folder / "data" / f"{name}.jsonl"
    if not path.is_file():
        raise InputError(f"{path}: found no file; 'python -m tools.results take {name} SWEEP' writes its rows")
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def title_of(key: str) -> str:
    """Return the head of a column: of a quantity, its title; of anything else, its key in words."""
    if (known := key.removeprefix(WORST)) in BY_KEY:
        return f"{BY_KEY[known].title}{', worst camera' * key.startswith(WORST)}"
    return f"{key.removeprefix('ms_')}, ms" if key.startswith("ms_") else key.replace("_", " ")


def entry(key: str, values: Sequence[Any]) -> str:
    """Return a cell of a table: mean and standard deviation over seeds; other facts as they stand."""
    if (known := key.removeprefix(WORST)) in BY_KEY:
        return str(cell(known, statistics.fmean(values), spread(values)))
    if key.startswith("ms_"):
        mean = statistics.fmean(values)
        return "-" if math.isnan(mean) else f"{mean:.0f}"
    texts = dict.fromkeys("-" if isinstance(value, float) and math.isnan(value) else str(value) for value in values)
    return ", ".join(texts)


def table_of(rows: Sequence[Row], keys: Sequence[str]) -> str:
    """Return a Markdown table with a line for each scene, name and number of frames, in the order of the rows.

    Rows without a name are a line each, and their columns the keys alone.
    """
    lines: dict[tuple[Any, ...], list[Row]] = {}
    for number, row in enumerate(rows):
        lines.setdefault(_which(row)[:3] if "name" in row else (number,), []).append(row)
    named = all("name" in row for row in rows)
    scenes = named and len({row["scene"] for row in rows}) > 1
    heads = ["run", *(["recording"] if scenes else []), "frames", "seeds"] if named else []
    table = [[*heads, *map(title_of, keys)]]
    for found, runs in lines.items():
        cells = [entry(key, [run.get(key, math.nan) for run in runs]) for key in keys]
        facts = [f"`{found[1]}`", *([found[0]] if scenes else []), str(found[2]), str(len(runs))] if named else []
        table.append([*facts, *cells])
    return format_table(table)


def number_of(found: re.Match[str], rows: Sequence[Row]) -> str:
    """Return what stands in a sentence: a mean over seeds, or how two runs or curves differ. Raises InputError."""
    if found["sign"] == "%":
        curves = [_curve(rows, name, found["key"]) for name in (found["other"], found["name"])]
        return f"{bd_rate(*curves):+.0f}"

    def by_seed(name: str) -> dict[int, float]:
        scene, _, run = name.replace("~", " ").rpartition("/")
        some = [row for row in rows if row["name"] == run and scene in ("", row["scene"])]
        values = {row["seed"]: row[found["key"]] for row in some if found["key"] in row}
        if not values or len(values) < len(some):
            where = f"{found['file']}.jsonl, got {len(some)} rows"
            raise InputError(f"{found[0]}: expected one such number a seed in {where}")
        return values

    values = by_seed(found["name"])
    others = by_seed(found["other"] or found["name"])
    # Two runs are compared on the seeds that both have, because those share a frame 0.
    value, other = (statistics.fmean(some[seed] for seed in values if seed in others) for some in (values, others))
    if found["sign"] == "/":
        ratio = value / other
        return f"{ratio:.0f}" if ratio >= 10 else f"{ratio:.1f}"
    if found["sign"] == "-":
        return f"{abs(value - other):{BY_KEY[found['key']].form.lstrip('+')}}"
    return cell(found["key"], value) if found["key"] in BY_KEY else f"{value:.3g}"


def _curve(rows: Sequence[Row], name: str, quality: str) -> list[tuple[float, float]]:
    """Return (KB a frame, quality) of the runs of a curve by rising bytes, without points that a cheaper one beats."""
    points = [(row["kb"], row[quality]) for row in rows if row["name"].startswith(f"{name} ")]
    return [points[i] for i in pareto_front(points)]


def filled(text: str, folder: Path) -> str:
    """Return a page with its tables and numbers made from the data. Raises InputError for what it does not know."""

    def made(found: re.Match[str]) -> str:
        files, keys = [name.strip() for name in found["files"].split(",")], found["keys"].split()
        rows = [row for name in files for row in read_rows(name, folder)]
        unknown = [key for key in keys if key not in BY_KEY and not any(key in row for row in rows)]
        if unknown:
            raise InputError(f"rows of {found['files']}: unknown quantities {unknown}; known: {', '.join(BY_KEY)}")
        if found["only"] is not None:
            rows = _only(rows, found["only"].split())
        head = found[0].split("\n", 1)[0]
        return f"{head}\n{table_of(rows, keys)}\n<!-- end of rows -->"

    def number(found: re.Match[str]) -> str:
        start = found[0][: found.start("value") - found.start()]
        return f"{start}{number_of(found, read_rows(found['file'], folder))}<!-- end -->"

    return NUMBER.sub(number, TABLE.sub(made, text))


def _only(rows: Sequence[Row], names: Sequence[str]) -> list[Row]:
    """Return the rows of some names, in the order of the names; ``~`` stands for the space within a name."""
    wanted = [name.replace("~", " ") for name in names]
    known = {row["name"] for row in rows}
    if missing := set(wanted) - known:
        raise InputError(f"only {sorted(missing)}: there are no such rows; known: {sorted(known)}")
    return [row for name in wanted for row in rows if row["name"] == name]


def fill(pages: Sequence[Path], check: bool, folder: Path = PAGES) -> list[Path]:
    """Fill in pages with the data of a folder, or only look; return those that differed."""
    differ = []
    for page in pages:
        text = page.read_text(encoding="utf-8")
        now = filled(text, folder)
        if now != text:
            differ.append(page)
            if not check:
                page.write_text(now, encoding="utf-8")
    return differ


def take(name: str, sweep: Path, commit: str, at: Sequence[int] = ()) -> None:
    """Write the numbers of a sweep to its data file."""
    path = PAGES / "data" / f"{name}.jsonl"
    path.parent.mkdir(exist_ok=True)
    before = read_rows(name, PAGES) if path.is_file() else []
    rows = merged(before, rows_of_sweep(sweep, commit, at, curve=name in WITH_CURVES))
    path.write_text("".join(f"{json.dumps(row)}\n" for row in rows), encoding="utf-8")
    print(f"{len(rows)} runs in {path}")


def run(names: Iterable[str], data: Path, out: Path) -> None:
    """Run plans, one core a run, and take their numbers. Raises InputError where no commit can be named for them."""

    def git(*command: str) -> str:
        return subprocess.run(["git", *command], cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()

    if git("status", "--porcelain", "--untracked-files=no", "--", ".", ":!docs/results"):
        raise InputError("the working tree differs from its last commit, which the numbers are to name; commit first")
    for name in names:
        command = ["gsstream", "sweep", str(PLANS / f"{name}.yaml"), "--data", str(data), "--out", str(out / name)]
        subprocess.run([*command, "--workers", "1"], check=False)  # what failed is in the sweep's table
        take(name, out / name, git("rev-parse", "--short", "HEAD"))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one of the commands; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.results", description=__doc__.split("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    all_plans = sorted(path.stem for path in PLANS.glob("*.yaml"))
    running = commands.add_parser("run", help="run plans, take their numbers, fill in the pages")
    running.add_argument("names", nargs="*", metavar="NAME", help=f"all of {', '.join(all_plans)}, when left out")
    running.add_argument("--data", type=Path, required=True, help="folder of the recordings")
    running.add_argument("--out", type=Path, required=True, help="folder of the sweeps; those there are continued")
    taking = commands.add_parser("take", help="write the numbers of a finished sweep to docs/results/data")
    taking.add_argument("name")
    taking.add_argument("sweep", type=Path)
    taking.add_argument("--commit", required=True, help="of the code that ran")
    taking.add_argument("--at", type=int, nargs="*", default=[], metavar="FRAME", help="what changed in it and is seen")
    pages = commands.add_parser("fill", help="make the tables and numbers of the pages from the data")
    pages.add_argument("--check", action="store_true", help="only say which pages differ")
    given = parser.parse_args(arguments)
    if given.command == "take":
        take(given.name, given.sweep, given.commit, given.at)
        return 0
    if given.command == "run":
        run(given.names or all_plans, given.data, given.out)
    check = given.command == "fill" and given.check
    differ = fill(FILLED, check)
    for page in differ:
        print(f"{page.name} {'differs from its data' if check else 'made from its data'}")
    return 1 if check and differ else 0


if __name__ == "__main__":
    raise SystemExit(main())
