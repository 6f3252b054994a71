"""Measure the worst relative error of every stage against float64 and write the table of docs/reference/numerics.md.

    python tests/numerics/worst_errors.py [--seeds 200] [--write]

The bounds are those that tests/numerics/test_numerics_errors.py asserts: one table, numeric_bounds.py.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).parents[1]))
from numeric_bounds import BOUNDS
from numeric_errors import render_measures
from numeric_method_errors import method_measures

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "numerics.md"
BEGIN, END = "<!-- worst errors: begin -->", "<!-- worst errors: end -->"


def measured(seeds: Iterable[int]) -> dict[str, float]:
    """Stage -> worst error over these seeds, in the order of the bounds; stages that are not installed are absent."""
    measures = {**render_measures(), **method_measures()}
    return {name: max(measures[name](seed) for seed in seeds) for name in BOUNDS if name in measures}


def table(errors: Mapping[str, float], seeds: int, machine: str) -> str:
    """The table as it stands in the page."""
    lines = [
        BEGIN,
        f"Worst of {seeds} seeds on {machine}.",
        "",
        "| stage | worst error | bound | relative to |",
        "|---|---|---|---|",
    ]
    for name, error in errors.items():
        bound = BOUNDS[name]
        lines.append(f"| {name} | {error:.2g} | {bound.limit:.2g} | {bound.relative_to} |")
    return "\n".join([*lines, END])


def machine() -> str:
    """Processor and instruction set."""
    try:
        text = Path("/proc/cpuinfo").read_text()
        model = next(line.split(":", 1)[1].strip() for line in text.splitlines() if line.startswith("model name"))
    except (OSError, StopIteration):
        model = "an unnamed processor"
    try:
        from gsstream_cpu_render import _native
    except ImportError:
        return model
    return f"{model}, {_native.active_isa()}"


def main() -> int:
    """0: every error is within its bound."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--write", action="store_true", help="put the table into the page")
    given = parser.parse_args()
    torch.set_num_threads(1)  # tables are tiny
    errors = measured(range(given.seeds))
    text = table(errors, given.seeds, machine())
    print(text)
    if given.write:
        page = PAGE.read_text(encoding="utf-8")
        before, rest = page.split(BEGIN)
        PAGE.write_text(before + text + rest.split(END)[1], encoding="utf-8")
    beyond = [name for name, error in errors.items() if not error <= BOUNDS[name].limit]
    if beyond:
        print("beyond their bound:", ", ".join(beyond), file=sys.stderr)
    return 1 if beyond else 0


if __name__ == "__main__":
    sys.exit(main())
