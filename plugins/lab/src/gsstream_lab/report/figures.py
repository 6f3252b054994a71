"""Figures of a report as PNG bytes: quality against cost, and curves over frames."""

from __future__ import annotations

import io
import math
import statistics
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, StrMethodFormatter

from gsstream.evaluation.plots import COLORS, plot_runs
from gsstream_lab.report.fronts import knee, pareto_front
from gsstream_lab.report.groups import Group, seed_noise, waited
from gsstream_lab.report.quantities import BY_KEY, COSTS, DRAWN_QUALITIES

_CURVES = len(COLORS)
#: With more variants than colours, the next ones have another shape.
_SHAPES = "os^DPX"
_QUALITY = {
    "psnr": "PSNR, dB",
    "psnr_moving": "PSNR on moving pixels, dB",
    "psnr_changed": "PSNR on changed pixels, dB",
}


def measured_costs(groups: Sequence[Group]) -> list[str]:
    """Return costs that every group has; no wall time of runs that waited for the processor."""
    useless = {"seconds"} if waited(groups) else set()
    return [key for key in COSTS if key not in useless and all(math.isfinite(group.mean(key)) for group in groups)]


def measured_goods(groups: Sequence[Group]) -> list[str]:
    """Return qualities that every group has; none where no camera is held out."""
    return [key for key in DRAWN_QUALITIES if all(math.isfinite(group.mean(key)) for group in groups)]


def pareto_figure(groups: Sequence[Group], title: str) -> bytes:
    """Draw a panel for each quality and cost that all groups have: groups with their spread over seeds, and the front.

    The front is a dark line with its knee in a ring; where recipes differ in one knob alone, a thin line joins those of
    one variant. Points far below the rest stand at the lower edge as triangles with their value. Names that would cover
    one another are left out; the names of points on the front are left out last.
    """
    costs = measured_costs(groups)
    goods = measured_goods(groups)
    joined = len({key for group in groups for key in group.axes}) == 1
    figure = Figure(figsize=(3.6 * len(costs), 3.4 * len(goods)), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(goods), len(costs), squeeze=False, sharey="row", sharex="col")
    variants = list(dict.fromkeys(group.variant for group in groups))
    looks = {name: _look(i) for i, name in enumerate(variants)}
    for row, good in enumerate(goods):
        for column, cost in enumerate(costs):
            axis = axes[row, column]
            _panel(axis, groups, good, cost=cost, looks=looks)
            for name in variants if joined else ():
                line = sorted((group.mean(cost), group.mean(good)) for group in groups if group.variant == name)
                axis.plot(*zip(*line, strict=True), color=looks[name][0], linewidth=1, alpha=0.6)
                if len(line) > 1:
                    _name(axis, name, line[-1], True)
            if row == len(goods) - 1:
                axis.set_xlabel(BY_KEY[cost].title, fontsize=9)
        axes[row, 0].set_ylabel(_QUALITY[good], fontsize=9)
    handles = [
        axes[0, 0].scatter([], [], s=24, color=color, marker=shape, label=name)
        for name, (color, shape) in looks.items()
    ]
    # A letter is about a twelfth of an inch wide, and a mark with its gaps half an inch.
    wide = 0.5 + max(map(len, variants)) / 12
    columns = max(1, int(figure.get_figwidth() / wide))
    figure.legend(handles=handles, loc="outside lower center", ncols=columns, fontsize=9, frameon=False)
    figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    figure.canvas.draw()
    for axis in axes.flat:
        _thin_names(axis)
    return png(figure)


def _look(place: int) -> tuple[str, str]:
    """Colour and shape of a variant, unlike those of all others."""
    return COLORS[place % len(COLORS)], _SHAPES[place // len(COLORS) % len(_SHAPES)]


def floor_of(values: Sequence[float]) -> float:
    """Return where an axis of qualities starts: the least value, or a little below the better three quarters."""
    best, least = max(values), min(values)
    quarter = statistics.quantiles(values, n=4, method="inclusive")[0] if len(values) > 3 else least
    low = best - 2 * (best - quarter)
    return low if least < best - 4 * (best - quarter) else least


def _thin_names(axis: Any) -> None:
    """Hide names that cover one already kept, or leave the figure; those of the front are kept first."""
    kept: list[Any] = []
    for text in sorted(axis.texts, key=lambda text: -text.get_zorder()):
        box = text.get_window_extent()
        if box.x1 > axis.figure.bbox.x1 or any(box.overlaps(other) for other in kept):
            text.set_visible(False)
        else:
            kept.append(box)


def _panel(axis: Any, groups: Sequence[Group], good: str, cost: str, looks: dict[str, tuple[str, str]]) -> None:
    points = [(group.mean(cost), group.mean(good)) for group in groups]
    noise = seed_noise(groups, good)
    order = pareto_front(points)
    floor = floor_of([y for _, y in points])
    for index, (group, (x, y)) in enumerate(zip(groups, points, strict=True)):
        if y < floor:
            axis.plot(x, floor, "v", markersize=6, color=looks[group.variant][0], clip_on=False)
            _name(axis, f"{group.variant} {y:.1f}", (x, floor), index in order)
            continue
        bars = {"xerr": group.spread(cost), "yerr": group.spread(good)} if len(group.runs) > 1 else {}
        size = 7 if not group.axes else 4
        color, shape = looks[group.variant]
        axis.errorbar(
            x,
            y,
            fmt=shape,
            markersize=size,
            color=color,
            alpha=0.9 if not group.axes else 0.6,
            elinewidth=1,
            markeredgewidth=0,
            **bars,
        )
        if not group.axes:
            _name(axis, group.variant, (x, y), index in order)
    front = [points[i] for i in order]
    axis.step(*zip(*front, strict=True), where="post", color="#444444", linewidth=1, zorder=0)
    axis.set_ylim(bottom=floor - 0.04 * (max(y for _, y in points) - floor) - 1e-3)
    if (at := knee(front)) is not None and front[at][1] >= floor:
        axis.plot(*front[at], "o", markersize=13, markerfacecolor="none", markeredgecolor="#444444")
    if math.isfinite(noise):
        axis.set_title(f"noise between seeds {noise:.3f} dB", fontsize=7, loc="right", color="#666666")
    style(axis, logarithmic=max(x for x, _ in points) > 8 * min(x for x, _ in points) > 0)


def style(axis: Any, *, logarithmic: bool) -> None:
    """Give a panel the look of all panels of a report."""
    if logarithmic:
        axis.set_xscale("log")
        axis.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.xaxis.set_minor_formatter(NullFormatter())
    axis.spines[["top", "right"]].set_visible(False)
    axis.grid(color="#e5e5e5", linewidth=0.6)
    axis.set_axisbelow(True)
    axis.tick_params(labelsize=8)


def _name(axis: Any, text: str, place: tuple[float, float], first: bool) -> None:
    axis.annotate(text, place, xytext=(5, 4), textcoords="offset points", fontsize=8, zorder=4 if first else 3)


def frame_curves(groups: Sequence[Group], title: str) -> bytes:
    """Draw curves over frames of the first seed of up to seven groups."""
    runs = {group.label: list(group.runs[0].records) for group in groups[:_CURVES]}
    with tempfile.TemporaryDirectory() as folder:
        return plot_runs(runs, Path(folder) / "curves.png", title).read_bytes()


def curve_groups(groups: Sequence[Group]) -> list[Group]:
    """Return whose curves are drawn: the variants as they are; without any, the front of PSNR against KB/frame."""
    plain = [group for group in groups if not group.axes]
    if plain:
        return plain[:_CURVES]
    front = pareto_front([(group.mean("kb"), group.mean("psnr")) for group in groups])
    return [groups[i] for i in front][:_CURVES] or list(groups)[:_CURVES]


def png(figure: Figure) -> bytes:
    """Return a figure as the bytes of a PNG, the same for the same figure."""
    out = io.BytesIO()
    figure.savefig(out, format="png", metadata={"Software": None})
    return out.getvalue()
