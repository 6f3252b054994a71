"""Runs held against a budget: ``python -m tools.held --budget size=10KB RUN...``, made under it or not.

Makes the tables of docs/results/trade.md from the ``metrics.jsonl`` of run folders, and from the fixed recipes of a
sweep (``--sweep DIR SCENE``).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from gsstream_lab.report.groups import read_sweep_data
from gsstream_lab.sweep.tune import Trial, trial_of, tune_table

from gsstream.core.errors import GsstreamError
from gsstream.evaluation.records import read_lines, read_records
from gsstream.plugins.catalog import load_catalog
from gsstream.recipe.budget import budget_overrides
from gsstream.recipe.load import resolve_recipe


def held_table(
    runs: Sequence[Path], budget: str, frames: int | None = None, sweep: tuple[Path, str] | None = None
) -> str:
    """A row per run folder, then one per recipe of a sweep, by its first seed.

    Arguments:
        frames: only the first so many. sweep: its folder, and the scene.

    Raises InputError for what is no run, no sweep or no budget.
    """
    limits = resolve_recipe(None, load_catalog().recipe_path, (), budget_overrides(budget)).recipe.budget
    trials: list[Trial] = []
    for run in runs:
        read_records(run)  # says which line is not a frame's
        lines = read_lines(run / "metrics.jsonl")[:frames]
        trials.append(trial_of(run.name, {"status": "done", "frames": lines}, limits))
    groups = [] if sweep is None else read_sweep_data(sweep[0]).of(sweep[1])
    rows = [{"status": "done", "frames": group.runs[0].row["frames"][:frames]} for group in groups]
    trials += [trial_of(group.label, row, limits) for group, row in zip(groups, rows, strict=True)]
    return tune_table(trials, None)


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table; 2 when something given is wrong."""
    parser = argparse.ArgumentParser(prog="python -m tools.held", description=__doc__)
    parser.add_argument("runs", nargs="*", type=Path, help="run folders")
    parser.add_argument("--sweep", nargs=2, metavar=("DIR", "SCENE"), help="folder of a sweep, and one of its scenes")
    parser.add_argument("--budget", required=True, help="limits, as for gsstream run")
    parser.add_argument("--frames", type=int, help="look at the first so many frames only")
    given = parser.parse_args(argv)
    try:
        sweep = (Path(given.sweep[0]), given.sweep[1]) if given.sweep else None
        print(held_table(given.runs, given.budget, given.frames, sweep))
    except GsstreamError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
