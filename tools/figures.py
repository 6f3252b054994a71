"""Figures of the results pages: quality against bytes, against seconds and over time, drawn from docs/results/data.

    python -m tools.figures [--check]

Each is an SVG that names the digest of the numbers it shows; with ``--check`` nothing is written, and a figure whose
numbers are no longer those of the data is named (exit code 1).
"""

from __future__ import annotations

import argparse
import hashlib
import json
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
from gsstream_lab.report.figures import style
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from gsstream.evaluation.plots import COLORS
from tools.results import PAGES, Row, read_rows

IMAGES = PAGES.parent / "images"
#: Whose names are beside their points; all others are points.
NAMED = ("s2gs-edge", "comgs-l", "comgs-s", "dense-tuned", "quarc", "queen", "hicom")
#: Where a name would cover another one's: its place from the point, in printer's points.
BELOW = {"queen": (6, -12), "comgs-s": (6, -12)}
#: Who is drawn over the frames.
DRAWN = ("s2gs-edge", "dense-tuned", "comgs-l", "quarc", "stream3dgs-cells", "queen", "hicom")


class Point(NamedTuple):
    """A method: means over its seeds."""

    name: str
    cost: float
    quality: float


class Picture(NamedTuple):
    """A figure: the numbers that it shows, and how they are drawn."""

    numbers: Sequence[Any]
    draw: Callable[[Any, Sequence[Any]], None]


def _by_name(rows: Sequence[Row]) -> dict[str, list[Row]]:
    out: dict[str, list[Row]] = {}
    for row in rows:
        out.setdefault(row["name"], []).append(row)
    return out


def points_of(rows: Sequence[Row], cost: str) -> list[Point]:
    """Return the methods of rows that change something, in their order: mean cost, and mean PSNR of changed pixels."""
    sends = [row for row in rows if row["kb"] > 0.5]  # hold, which sends nothing, has no place on an axis of powers
    return [
        Point(name, *(round(statistics.fmean(run[key] for run in runs), 2) for key in (cost, "psnr_changed")))
        for name, runs in _by_name(sends).items()
    ]


def draw_points(axis: Any, points: Sequence[Point]) -> None:
    """Draw methods, ours larger."""
    for point in points:
        ours = point.name.startswith("s2gs")
        axis.plot(point.cost, point.quality, "o", color=COLORS[1 if ours else 0], markersize=7 if ours else 5)
        if point.name in NAMED:
            place = BELOW.get(point.name, (6, 3))
            axis.annotate(point.name, (point.cost, point.quality), xytext=place, textcoords="offset points", fontsize=9)
    style(axis, logarithmic=True)
    axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.margins(x=0.12)
    axis.set_ylabel("PSNR of changed pixels, dB", fontsize=9)


def curves_of(rows: Sequence[Row]) -> list[tuple[str, list[float]]]:
    """Return (method, mean PSNR of every frame over its seeds)."""
    drawn = [row for row in rows if row["name"] in DRAWN]
    return [
        (
            name,
            [round(statistics.fmean(values), 2) for values in zip(*(run["curve_psnr"] for run in runs), strict=True)],
        )
        for name, runs in _by_name(drawn).items()
    ]


def draw_curves(axis: Any, curves: Sequence[tuple[str, list[float]]]) -> None:
    """Draw the PSNR of whole pictures over the frames, each line with its name in the legend, the best first."""
    by_end = sorted(curves, key=lambda curve: -statistics.fmean(curve[1][-5:]))
    for color, (name, values) in zip(COLORS, by_end, strict=False):
        axis.plot(range(len(values)), values, color=color, linewidth=1.5, label=name)
    style(axis, logarithmic=False)
    axis.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    axis.set_xlabel("frame", fontsize=9)
    axis.set_ylabel("PSNR, dB", fontsize=9)


def pictures(folder: Path = PAGES) -> dict[str, Picture]:
    """Return the figures by the names of their files."""
    rows = read_rows("protocol", folder)

    def against(cost: str, label: str) -> Picture:
        def draw(axis: Any, points: Sequence[Point]) -> None:
            draw_points(axis, points)
            axis.set_xlabel(label, fontsize=9)

        return Picture(points_of(rows, cost), draw)

    return {
        "quality-bytes.svg": against("kb", "KB a frame"),
        "quality-seconds.svg": against("cpu_seconds", "processor seconds a frame"),
        "quality-time.svg": Picture(curves_of(rows), draw_curves),
    }


def digest_of(picture: Picture) -> str:
    """Return the name of the numbers of a figure."""
    return hashlib.sha256(json.dumps(picture.numbers).encode()).hexdigest()[:16]


def write(path: Path, picture: Picture) -> None:
    """Draw a figure."""
    with mpl.rc_context({"svg.hashsalt": "gsstream", "svg.fonttype": "none", "font.family": "sans-serif"}):
        figure = Figure(figsize=(7.2, 4.0), layout="constrained")
        FigureCanvasSVG(figure)
        picture.draw(figure.subplots(), picture.numbers)
        facts = {"Date": None, "Creator": None, "Description": f"numbers {digest_of(picture)}"}
        figure.savefig(path, format="svg", metadata=facts)


def stale(images: Path = IMAGES, folder: Path = PAGES) -> list[str]:
    """Return the figures that show other numbers than the data."""
    found = []
    for name, picture in pictures(folder).items():
        path = images / name
        if not path.is_file() or f"numbers {digest_of(picture)}" not in path.read_text(encoding="utf-8"):
            found.append(name)
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw what is stale, or only name it; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.figures", description=__doc__.split("\n")[0])
    parser.add_argument("--check", action="store_true", help="only say which figures differ")
    given, names = parser.parse_args(arguments), stale()
    for name in names:
        if not given.check:
            write(IMAGES / name, pictures()[name])
        print(f"{name} {'differs from its data' if given.check else 'drawn from its data'}")
    return 1 if given.check and names else 0


if __name__ == "__main__":
    raise SystemExit(main())
