"""The pictures of a run folder: contact sheet, per-frame plots, summary table, video."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from gsstream.engine.budget.report import budget_lines
from gsstream.engine.run.live import latency_lines
from gsstream.evaluation.records import FrameRecord, read_lines, read_records
from gsstream.evaluation.summary import later_keys_line, summarise, summary_table
from gsstream.input.recordings.base import Source
from gsstream.packet import StreamMeta
from gsstream.player.playback import Playback

STREAM, METRICS = "stream.gss", "metrics.jsonl"
SHEET, PLOTS, SUMMARY, VIDEO = "contact_sheet.png", "frames.png", "summary.txt", "video.mp4"
COLUMNS = 5
#: Most lamps that a summary names.
MOST_LAMPS = 6
NO_FILES: Mapping[int, Path] = MappingProxyType({})


def write_gallery(out: Path, source: Source, *, pictures: bool = True, video: bool = True) -> list[Path]:
    """Write the summary and every picture a person would look for first; return the files that were written."""
    with Playback(out / STREAM) as playback:
        frames, meta = playback.frames, playback.meta
    records = read_records(out / METRICS)
    written = [_write_summary(out, meta, records)]
    if not pictures:
        return written
    written += _still_pictures(out, source, meta, records)
    if video and len(frames) > 1 and importlib.util.find_spec("av") is not None:
        from gsstream.player.play import play

        play(out / STREAM, out / VIDEO, camera=(meta.test.ids or meta.train.ids)[0])
        written.append(out / VIDEO)
    return written


def _still_pictures(out: Path, source: Source, meta: StreamMeta, records: Sequence[FrameRecord]) -> list[Path]:
    from gsstream.evaluation.plots import plot_runs

    written = [write_sheet(out, source)]
    # Frame 0 alone, and no test camera to measure it: there is no curve to draw.
    if len(records) > 1 or records[0].psnr:
        title = f"{meta.title} on {source.info.name}"
        written.append(plot_runs({meta.title: records}, out / PLOTS, title=title))
    return written


def _write_summary(out: Path, meta: StreamMeta, records: Sequence[FrameRecord]) -> Path:
    text = [summary_table({meta.title: summarise(records)}), "", held_out_line(meta)]
    text += ["", later] if (later := later_keys_line(records)) else []
    lines = read_lines(out / METRICS)
    text += ["", drifted] if (drifted := drift_line(lines, meta.train.ids)) else []
    text += ["", lit] if (lit := lamp_line(lines)) else []
    if lines[0].get("blank_views") == len(meta.train):
        text += [
            "",
            "frame 0 shows nothing in any training camera, and everything is built on it: begin at a later frame",
        ]
    for part in (latency_lines(lines), budget_lines(lines)):
        text += ["", *part] if part else []
    (out / SUMMARY).write_text("\n".join(text) + "\n", encoding="utf-8")
    return out / SUMMARY


def lamp_line(lines: Sequence[Mapping[str, Any]]) -> str:
    """Return in which frames a lamp was switched, and its factors of red, green and blue; empty where none was."""
    found = [
        f"frame {line['frame']} x {'/'.join(f'{value:.2f}' for value in line['lamp'])}"
        for line in lines
        if "lamp" in line
    ]
    more = f" and {len(found) - MOST_LAMPS} more" if len(found) > MOST_LAMPS else ""
    return f"everything became brighter or darker at once: {', '.join(found[:MOST_LAMPS])}{more}" if found else ""


def drift_line(lines: Sequence[Mapping[str, Any]], cameras: Sequence[str]) -> str:
    """Return which training cameras drifted alone, and how far by red, green and blue; empty where none did."""
    told: Sequence[Sequence[float]] = next((line["camera_drift"] for line in lines[::-1] if "camera_drift" in line), [])
    found = [
        f"{name} {'/'.join(f'{value:+.1f}' for value in by_channel)} %"
        for name, by_channel in zip(cameras, told, strict=False)
        if any(by_channel)
    ]
    return f"cameras that became brighter or darker alone: {', '.join(found)}; fix their exposure" if found else ""


def write_sheet(out: Path, source: Source, fresh: Mapping[int, Path] = NO_FILES) -> Path:
    """Write the contact sheet of a run: a few frames, and those of which ``fresh`` holds another stream."""
    from gsstream.evaluation.contact_sheet import sheet_of_stream

    with Playback(out / STREAM) as playback:
        frames = playback.frames
    chosen = {int(i) for i in np.linspace(frames[0], frames[-1], min(COLUMNS, len(frames)))}
    return sheet_of_stream(out / STREAM, source, sorted(chosen | set(fresh)), out / SHEET, fresh=fresh)


def held_out_line(meta: StreamMeta) -> str:
    """Return the sentence that says which test cameras a run has, and by which split."""
    if len(meta.test) == 0:
        return "no test camera: all of them train"
    split = meta.recipe.get("data", {}).get("split", "reporting")
    purpose = "training cameras left out, to choose settings" if split == "tuning" else "test cameras"
    return f"test cameras: {', '.join(meta.test.ids)} ({split} split: {purpose})"
