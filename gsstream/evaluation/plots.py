"""Per-frame curves of one or several runs as PNG: quality, bytes, seconds, Gaussians sent, open gates."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from gsstream.core.errors import InputError
from gsstream.evaluation.records import FrameRecord, mean

#: Colours that people who are colour-blind can tell apart, too (Okabe and Ito).
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000")
#: One number of a frame, or one after each of its epochs.
Series = Callable[[FrameRecord], float | tuple[float, ...]]


def _kilobytes(record: FrameRecord) -> float:
    return record.total_bytes / 1000 if record.bytes and not record.is_key else math.nan


def _seconds(record: FrameRecord) -> float:
    return sum(record.seconds.values()) if record.seconds else math.nan


def _sent(record: FrameRecord) -> float:
    return 100 * record.sent_gaussians / record.num_gaussians if record.num_gaussians else math.nan


#: Title, quantity, line from zero, frame 0 included.
_PANELS: Sequence[tuple[str, Series, bool, bool]] = (
    ("PSNR, dB", lambda r: mean(r.psnr.values()), False, True),
    ("PSNR on moving pixels, dB", lambda r: mean(r.psnr_moving.values()), False, False),
    ("PSNR on changed pixels, dB", lambda r: mean(r.psnr_changed.values()), False, False),
    ("KB per delta packet", _kilobytes, True, False),
    ("seconds per frame", _seconds, True, False),
    ("Gaussians sent, %", _sent, True, False),
    ("open gates after each epoch", lambda r: r.open_gates, True, False),
)


def plot_runs(runs: Mapping[str, Sequence[FrameRecord]], out: str | os.PathLike[str], title: str = "") -> Path:
    """Draw one panel per quantity, one line per run, and save a PNG. Quantities that were not measured get no panel.

    Raises InputError when there is nothing to draw.
    """
    curves = {}
    for label, quantity, zero, first in _PANELS:
        lines = {name: _line(records if first else records[1:], quantity) for name, records in runs.items()}
        lines = {name: line for name, line in lines.items() if line[0]}
        if lines:
            curves[label] = (lines, zero)
    if not curves:
        raise InputError("nothing to plot: no run has a measured frame")
    # Margins in inches, by hand: matplotlib's own layout draws everything twice, a second and a half for every run.
    below, height = (0.85 if len(runs) > 1 else 0.55), 1.7 * len(curves)
    total = height + below + 0.45
    figure = Figure(figsize=(8, total), dpi=120)
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(curves), 1, sharex=True, squeeze=False)[:, 0]
    figure.subplots_adjust(left=0.08, right=0.98, bottom=below / total, top=1 - 0.7 / total, hspace=0.3)
    colors = {name: COLORS[i % len(COLORS)] for i, name in enumerate(runs)}
    for axis, (label, (lines, zero)) in zip(axes, curves.items(), strict=True):
        for name, (x, y) in lines.items():
            style = {"marker": "o", "markersize": 3} if len(x) < 3 else {}
            axis.plot(x, y, color=colors[name], linewidth=1.3, label=name, **style)
        axis.set_title(label, loc="left", fontsize=9)
        if zero:
            axis.set_ylim(0, 1.1 * max(max(y) for _, y in lines.values()) or 1)
        _restrain(axis)
    axes[-1].set_xlabel("frame", fontsize=9)
    if len(runs) > 1:
        handles = axes[0].get_legend_handles_labels()
        figure.legend(*handles, loc="lower center", ncols=4, fontsize=9, frameon=False)
    if title:
        figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    out = Path(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out)
    return out


def _line(records: Sequence[FrameRecord], quantity: Series) -> tuple[list[float], list[float]]:
    """Numbers of one frame are spread over the span from the frame before it."""
    points = []
    for record in records:
        found = quantity(record)
        values = found if isinstance(found, tuple) else (found,)
        points += [(record.frame - 1 + place / len(values), value) for place, value in enumerate(values, 1)]
    points = [(x, value) for x, value in points if math.isfinite(value)]
    return [x for x, _ in points], [value for _, value in points]


def _restrain(axis: Any) -> None:
    axis.spines[["top", "right"]].set_visible(False)
    axis.grid(axis="y", color="#dddddd", linewidth=0.6)
    axis.set_axisbelow(True)
    axis.tick_params(labelsize=8)
    axis.xaxis.get_major_locator().set_params(integer=True)
