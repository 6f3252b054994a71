"""One row per run: the definitions of the project's tables, applied to its frame records."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from gsstream.evaluation.records import FrameRecord, mean
from gsstream.metrics import slope_per_100


@dataclass(frozen=True, slots=True)
class Summary:
    """Definitions: frame 0 apart from the rest; per frame the mean over cameras, then the mean over frames 1..T-1."""

    frames: int  # number of frames T
    #: psnr_first, psnr: dB, frame 0 and the mean of later frames.
    psnr_first: float
    psnr: float
    psnr_slope: float  # dB per 100 frames; nan where a later key packet began the scene anew: that is no drift
    ssim: float  # mean of later frames
    psnr_moving: float  # dB on moving pixels, mean of later frames where something moves
    kb_per_frame: float  # bytes of delta and empty packets over their number, 1 KB = 1,000 bytes
    key_kb: float  # bytes of the first key packet
    kb_amortised: float  # all bytes over all frames
    #: seconds_first, seconds: frame 0 and the mean of later frames.
    seconds_first: float
    seconds: float
    sent: float  # share of Gaussians behind open gates, mean of later frames; gates: share of open gates
    gates: float
    gates_per_sent: float  # open gates for each Gaussian that is sent, mean of later frames that send any
    peak_memory_mb: float  # largest of all frames
    psnr_changed: float = math.nan  # the same on changed pixels, the bodies without shadows and rims


def summarise(records: Sequence[FrameRecord]) -> Summary:
    """Summarise the frame records of one run; the first record is frame 0."""
    first, later = records[0], records[1:]
    quality = [(r.frame, mean(r.psnr.values())) for r in later if r.psnr]
    finite = [(frame, value) for frame, value in quality if math.isfinite(value)]
    deltas = [r.total_bytes / 1000 for r in later if r.bytes and not r.is_key]
    sized = [r.total_bytes / 1000 for r in records if r.bytes]
    return Summary(
        frames=len(records),
        psnr_first=mean(first.psnr.values()),
        psnr=mean(value for _, value in quality),
        psnr_slope=math.nan
        if any(r.is_key for r in later)
        else slope_per_100([frame for frame, _ in finite], [value for _, value in finite]),
        ssim=mean(mean(r.ssim.values()) for r in later),
        psnr_moving=mean(mean(r.psnr_moving.values()) for r in later),
        kb_per_frame=mean(deltas),
        key_kb=first.total_bytes / 1000 if first.bytes else math.nan,
        kb_amortised=mean(sized),
        seconds_first=sum(first.seconds.values()) if first.seconds else math.nan,
        seconds=mean(sum(r.seconds.values()) for r in later if r.seconds),
        sent=mean(r.sent_gaussians / r.num_gaussians for r in later if r.num_gaussians),
        gates=mean(r.active_gates / r.num_gates for r in later if r.num_gates),
        gates_per_sent=mean(r.active_gates / r.sent_gaussians for r in later if r.sent_gaussians),
        peak_memory_mb=max((r.peak_memory_mb for r in records if math.isfinite(r.peak_memory_mb)), default=math.nan),
        psnr_changed=mean(mean(r.psnr_changed.values()) for r in later),
    )


#: Later key packets that are listed one by one.
_LISTED = 6


def later_keys_line(records: Sequence[FrameRecord]) -> str:
    """Return which later frames were sent as key packets, and their sizes; empty where none was."""
    keys = [f"frame {r.frame} ({r.total_bytes / 1000:.1f} KB)" for r in records[1:] if r.is_key]
    more = f" and {len(keys) - _LISTED} more" if len(keys) > _LISTED else ""
    return f"later key packets: {', '.join(keys[:_LISTED])}{more}" if keys else ""


#: Frames of the shortest run whose slope is shown: over fewer, dB per 100 frames is noise times a large number.
MIN_FOR_SLOPE = 10
_COLUMNS: Mapping[str, tuple[str, str]] = {
    "frames": ("T", "{:d}"), "psnr_first": ("PSNR 0", "{:.2f}"), "psnr": ("PSNR", "{:.2f}"),
    "psnr_slope": ("dB/100", "{:+.2f}"), "psnr_moving": ("moving", "{:.2f}"),
    "psnr_changed": ("changed", "{:.2f}"), "ssim": ("SSIM", "{:.4f}"),
    "kb_per_frame": ("KB/frame", "{:.1f}"), "key_kb": ("key KB", "{:.0f}"), "kb_amortised": ("KB amort.", "{:.1f}"),
    "seconds": ("s/frame", "{:.2f}"), "seconds_first": ("s frame 0", "{:.1f}"), "sent": ("sent", "{:.1%}"),
    "gates": ("gates", "{:.1%}"), "gates_per_sent": ("gates/sent", "{:.1%}"), "peak_memory_mb": ("peak MB", "{:.0f}"),
}  # fmt: skip


def summary_table(runs: Mapping[str, Summary]) -> str:
    """Return a Markdown table, one row per run; "-" where nothing was measured."""
    rows = [["run", *(title for title, _ in _COLUMNS.values())]]
    for name, summary in runs.items():
        known = replace(summary, psnr_slope=math.nan) if summary.frames < MIN_FOR_SLOPE else summary
        rows.append([name, *(_cell(getattr(known, key), form) for key, (_, form) in _COLUMNS.items())])
    return format_table(rows)


def fitted(text: str, width: float) -> str:
    """Return a text whose Markdown tables that are wider than a terminal stand upright: a line for each column."""
    lines, out = text.splitlines(), list[str]()
    while lines:
        count = next((i for i, line in enumerate(lines) if not line.startswith("|")), len(lines))
        if count > 1 and max(map(len, lines[:count])) > width:
            rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[:count]]
            upright = format_table(list(zip(rows[0], *rows[2:], strict=True)))
            out += upright.splitlines()
        else:
            count = max(count, 1)
            out += lines[:count]
        lines = lines[count:]
    return "\n".join(out)


def format_table(rows: Sequence[Sequence[str]]) -> str:
    """Return Markdown with aligned columns: text left, numbers right. The first row is the head."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = []
    for number, row in enumerate(rows):
        cells = [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]
        lines.append("| " + " | ".join(cells) + " |")
        if number == 0:
            lines.append("|" + "-" * (widths[0] + 2) + "|" + "|".join("-" * (w + 1) + ":" for w in widths[1:]) + "|")
    return "\n".join(lines)


def _cell(value: float, form: str) -> str:
    if form == "{:.1f}" and 0 < value < 0.1:
        form = "{:.3f}"  # a packet has 16 bytes and must not be printed as 0
    return form.format(value) if math.isfinite(value) else "-"
