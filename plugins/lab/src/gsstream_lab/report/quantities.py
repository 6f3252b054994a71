"""What a report speaks of: every quantity with its unit, its better end, and how one run gives one number."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from gsstream.evaluation.records import FrameRecord, mean, mean_of_views
from gsstream.evaluation.summary import Summary, summarise
from gsstream_lab.energy import total_joules

Row = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Quantity:
    """A number of a run."""

    key: str  # name in the table of the paper, too
    title: str  # with its unit
    form: str  # how it is printed
    higher: bool | None  # whether more is better; None: neither
    #: (summary, frames after the first as written, cell record) -> number, nan where it was not measured.
    value: Callable[[Summary, Sequence[Row], Row], float]


def _per_frame(name: str) -> Callable[[Summary, Sequence[Row], Row], float]:
    return lambda _, frames, __: mean(float(frame[name]) for frame in frames if frame.get(name) is not None)


def _per_view(name: str) -> Callable[[Summary, Sequence[Row], Row], float]:
    return lambda _, frames, __: mean_of_views(frames, name)


def _of_run(name: str) -> Callable[[Summary, Sequence[Row], Row], float]:
    return lambda _, __, row: math.nan if row.get(name) is None else float(row[name])


def _joules(_: Summary, frames: Sequence[Row], __: Row) -> float:
    return mean(total_joules(frame["joules"]) for frame in frames if frame.get("joules"))


#: In the order of tables. Means over the frames after the first, over all test cameras.
QUANTITIES: tuple[Quantity, ...] = (
    Quantity("psnr_first", "PSNR 0, dB", ".2f", True, lambda s, _, __: s.psnr_first),
    Quantity("psnr", "PSNR, dB", ".2f", True, lambda s, _, __: s.psnr),
    Quantity("psnr_moving", "moving, dB", ".2f", True, lambda s, _, __: s.psnr_moving),
    Quantity("psnr_changed", "changed, dB", ".2f", True, lambda s, _, __: s.psnr_changed),
    Quantity("psnr_seen", "seen, dB", ".2f", True, _per_view("psnr_seen")),
    Quantity("psnr_changed_seen", "changed and seen, dB", ".2f", True, _per_view("psnr_changed_seen")),
    Quantity("psnr_slope", "dB/100", "+.2f", True, lambda s, _, __: s.psnr_slope),
    Quantity("ssim", "SSIM", ".4f", True, lambda s, _, __: s.ssim),
    Quantity("ms_ssim", "MS-SSIM", ".4f", True, _per_view("ms_ssim")),
    Quantity("lpips", "LPIPS", ".4f", False, _per_view("lpips")),
    Quantity("flip", "FLIP", ".4f", False, _per_view("flip")),
    Quantity("flicker", "flicker, /255", ".3f", False, _per_view("flicker")),
    Quantity("kb", "KB/frame", ".1f", False, lambda s, _, __: s.kb_per_frame),
    Quantity("key_kb", "key KB", ".0f", False, lambda s, _, __: s.key_kb),
    Quantity("seconds", "s/frame", ".2f", False, lambda s, _, __: s.seconds),
    Quantity("cpu_seconds", "CPU s/frame", ".2f", False, _per_frame("cpu_seconds")),
    Quantity("memory", "peak MB", ".0f", False, lambda s, _, __: s.peak_memory_mb),
    Quantity("joules", "J/frame", ".2f", False, _joules),
    Quantity("seconds_first", "s frame 0", ".1f", False, _of_run("first_seconds")),
    Quantity("fps", "pictures/s", ".0f", True, _of_run("fps")),
    Quantity("sent", "sent, %", ".1f", None, lambda s, _, __: 100 * s.sent),
    Quantity("gates_per_sent", "gates/100 sent", ".0f", None, lambda s, _, __: 100 * s.gates_per_sent),
    Quantity("gates", "gates, k", ".3f", None, lambda _, f, __: mean(x["active_gates"] / 1000 for x in f)),
    Quantity("gaussians", "Gaussians, k", ".1f", None, lambda _, f, __: mean(x["num_gaussians"] / 1000 for x in f)),
)
BY_KEY: Mapping[str, Quantity] = {quantity.key: quantity for quantity in QUANTITIES}
DRAWN_QUALITIES = ("psnr", "psnr_moving", "psnr_changed")
#: Pairs of quantities that a chart sets against each other: a quality, and its cost.
QUALITIES, COSTS = ("psnr", "psnr_moving"), ("kb", "seconds", "cpu_seconds", "memory", "joules")


def values_of(records: Sequence[FrameRecord], row: Row) -> dict[str, float]:
    """Return every quantity of one run; nan for what was not measured."""
    summary, later = summarise(records), row["frames"][1:]
    return {quantity.key: quantity.value(summary, later, row) for quantity in QUANTITIES}


def spread(values: Sequence[float]) -> float:
    """Return the standard deviation over seeds; nan with a single one, or when one did not measure it."""
    return statistics.stdev(values) if len(values) > 1 and all(map(math.isfinite, values)) else math.nan


def cell(key: str, value: float, spread: float = math.nan) -> str:
    """Return ``31.22`` or ``31.22 ± 0.04``; "-" for what was not measured."""
    if not math.isfinite(value):
        return "-"
    form = BY_KEY[key].form
    return format(value, form) if not math.isfinite(spread) else f"{value:{form}} ± {spread:{form.lstrip('+')}}"
