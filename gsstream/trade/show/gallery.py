"""The pictures of a run folder: contact sheet, per-frame plots, summary table, video."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np

from gsstream.engine.budget.report import budget_lines
from gsstream.packet import StreamMeta
from gsstream.player.play import play
from gsstream.player.playback import Playback
from gsstream.source.base import FrameSource
from gsstream.trade.measure.gap import fresh_files
from gsstream.trade.measure.records import read_lines, read_records
from gsstream.trade.measure.summary import summarise, summary_table
from gsstream.trade.show.contact_sheet import sheet_of_stream
from gsstream.trade.show.plots import plot_runs

STREAM, METRICS = "stream.gss", "metrics.jsonl"
SHEET, PLOTS, SUMMARY, VIDEO = "contact_sheet.png", "frames.png", "summary.txt", "video.mp4"
COLUMNS = 5


def write_gallery(out: Path, source: FrameSource, *, video: bool = True) -> list[Path]:
    """Write every picture a person would look for first; return what was written.

    Arguments:
        out: a run folder with a stream and metrics.
        source: the recording, at the scale of the run.
        video: also an MP4 of the first camera, when PyAV is installed (extra ``video``).
    """
    with Playback(out / STREAM) as playback:
        frames, method = playback.frames, playback.meta.title
        name = (playback.meta.test.ids or playback.meta.train.ids)[0]
        judges = judges_line(playback.meta)
    records = read_records(out / METRICS)
    written = [write_sheet(out, source)]
    # Frame 0 alone, and no test camera to measure it: there is no curve to draw.
    if len(records) > 1 or records[0].psnr:
        written.append(plot_runs({method: records}, out / PLOTS, title=f"{method} on {source.info.name}"))
    text = [summary_table({method: summarise(records)}), "", judges]
    budget = budget_lines(read_lines(out / METRICS))
    text += ["", *budget] if budget else []
    (out / SUMMARY).write_text("\n".join(text) + "\n", encoding="utf-8")
    written.append(out / SUMMARY)
    if video and len(frames) > 1 and importlib.util.find_spec("av") is not None:
        play(out / STREAM, out / VIDEO, camera=name)
        written.append(out / VIDEO)
    return written


def write_sheet(out: Path, source: FrameSource) -> Path:
    """Write the contact sheet of a run: a few frames, and those whose fresh reconstruction ``gsstream gap`` has made.

    Arguments:
        out: a run folder with a stream.
        source: the recording, at the scale of the run.
    """
    with Playback(out / STREAM) as playback:
        frames = playback.frames
    fresh = {frame: path for frame, path in fresh_files(out).items() if frame in frames}
    chosen = {int(i) for i in np.linspace(frames[0], frames[-1], min(COLUMNS, len(frames)))}
    return sheet_of_stream(out / STREAM, source, sorted(chosen | set(fresh)), out / SHEET, fresh=fresh)


def judges_line(meta: StreamMeta) -> str:
    """Return the sentence that says which cameras judged a run, and by which split."""
    if len(meta.test) == 0:
        return "no camera judged: all of them train"
    split = meta.recipe.get("data", {}).get("split", "reporting")
    purpose = "training cameras left out, to choose settings" if split == "tuning" else "test cameras"
    return f"judged by {', '.join(meta.test.ids)} ({split} split: {purpose})"
