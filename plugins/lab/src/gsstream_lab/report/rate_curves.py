"""Curves of quality against bytes: families of recipes that differ in one knob, compared by the Bjøntegaard delta.

One point says little about which of two recipes is better, because each could buy quality with bytes. A curve over one
knob, such as the weight of the rate term, says it at equal quality: BD-rate is the mean difference of the bytes, in
percent, over the qualities that both curves reach (Bjøntegaard, VCEG-M33, 2001; here with monotone cubic pieces).
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

from gsstream_lab.report.document import Block, Picture, Table
from gsstream_lab.report.fronts import pareto_front
from gsstream_lab.report.groups import Group
from gsstream_lab.report.quantities import BY_KEY, DRAWN_QUALITIES, cell

#: Fewer points than this make no curve.
MIN_POINTS = 3


@dataclass(frozen=True, slots=True)
class Curve:
    """Groups that differ in one axis alone, by its rising value."""

    name: str
    groups: tuple[Group, ...]

    def points(self, quality: str) -> list[tuple[float, float]]:
        """Return (KB/frame, dB) by rising bytes, without points that a cheaper one equals or beats."""
        points = [(group.mean("kb"), group.mean(quality)) for group in self.groups]
        return [points[i] for i in pareto_front(points)]


def curves_over(groups: Sequence[Group]) -> dict[str, list[Curve]]:
    """Return axis -> its curves, for axes in which at least two families have three values or more each."""
    found: dict[str, dict[str, list[Group]]] = {}
    for group in groups:
        for axis in group.axes:
            rest = Group(group.scene, group.variant, {k: v for k, v in group.axes.items() if k != axis}, ())
            found.setdefault(axis, {}).setdefault(rest.label, []).append(group)
    curves = {
        axis: [Curve(name, tuple(some)) for name, some in families.items() if len(some) >= MIN_POINTS]
        for axis, families in found.items()
    }
    return {axis: some for axis, some in curves.items() if len(some) > 1}


def bd_rate(anchor: Sequence[tuple[float, float]], other: Sequence[tuple[float, float]]) -> float:
    """Return by how many percent ``other`` needs more bytes than ``anchor`` at equal quality; nan: cannot be said."""
    from bjontegaard import bd_rate as library

    known = all(len(curve) >= MIN_POINTS and curve[0][0] > 0 for curve in (anchor, other))
    if not known or max(anchor[0][1], other[0][1]) >= min(anchor[-1][1], other[-1][1]):
        return math.nan
    (rates, quality), (other_rates, other_quality) = zip(*anchor, strict=True), zip(*other, strict=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that they overlap in part is said in the table's caption
        return float(
            library(
                list(rates),
                list(quality),
                list(other_rates),
                list(other_quality),
                method="pchip",
                require_matching_points=False,
            )
        )


def curve_blocks(groups: Sequence[Group], scene: str) -> list[Block]:
    """Return a table and a figure for every axis that makes curves; nothing when none does."""
    blocks: list[Block] = []
    for axis, curves in curves_over(groups).items():
        blocks += [
            _table(axis, curves),
            _READING,
            Picture(
                f"{scene}-{axis.rpartition('.')[2]}-curves.png",
                _figure(axis, curves),
                f"Quality against bytes on {scene}, a curve for each recipe over {axis}",
            ),
        ]
    return blocks


_READING = (
    "BD-rate is the mean difference of the bytes at equal quality, over the qualities that both curves reach; below 0 "
    "the recipe needs fewer bytes than the first row. Points that cost more bytes for no more quality are left out; "
    "'-' stands where fewer than three points are left, or where the curves share no quality."
)


def _table(axis: str, curves: Sequence[Curve]) -> Table:
    head = ["recipe", axis, "KB/frame"]
    for quality in DRAWN_QUALITIES:
        head += [BY_KEY[quality].title, "BD-rate"]
    rows = [head]
    for curve in curves:
        values = [group.axes[axis] for group in curve.groups]
        row = [curve.name, f"{values[0]} to {values[-1]}", _range(curve, "kb")]
        for quality in DRAWN_QUALITIES:
            delta = math.nan if curve is curves[0] else bd_rate(curves[0].points(quality), curve.points(quality))
            row += [_range(curve, quality), f"{delta:+.0f} %" if math.isfinite(delta) else "-"]
        rows.append(row)
    return Table(f"Curves over {axis}, against {curves[0].name}", rows)


def _range(curve: Curve, key: str) -> str:
    return f"{cell(key, curve.groups[0].mean(key))} to {cell(key, curve.groups[-1].mean(key))}"


def _figure(axis: str, curves: Sequence[Curve]) -> bytes:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from gsstream.evaluation.plots import COLORS
    from gsstream_lab.report.figures import png, style

    shown = [q for q in DRAWN_QUALITIES if any(math.isfinite(g.mean(q)) for curve in curves for g in curve.groups)]
    figure = Figure(figsize=(4.2 * len(shown), 3.8), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    for panel, quality in zip(figure.subplots(1, len(shown), squeeze=False)[0], shown, strict=True):
        for place, curve in enumerate(curves):
            points = sorted((group.mean("kb"), group.mean(quality)) for group in curve.groups)
            panel.plot(
                *zip(*points, strict=True),
                "o-",
                markersize=4,
                linewidth=1.2,
                color=COLORS[place % len(COLORS)],
                label=curve.name,
            )
        style(panel, logarithmic=True)
        panel.set_xlabel(BY_KEY["kb"].title, fontsize=9)
        panel.set_title(BY_KEY[quality].title, fontsize=9, loc="left")
    figure.legend(*panel.get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=9, frameon=False)
    figure.suptitle(f"curves over {axis}", fontsize=10, x=0.01, ha="left")
    return png(figure)
