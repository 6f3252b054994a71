"""The page of a comparison: what ran where, curves of quality against cost, numbers, pictures and a video."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from gsstream.input.recordings.base import FrameSource
from gsstream.player.playback import Playback
from gsstream_lab.compare.pictures import picture_files
from gsstream_lab.report.build import all_runs, where_it_ran
from gsstream_lab.report.document import Block, Heading, Picture, Table, Text
from gsstream_lab.report.figures import frame_curves, pareto_figure
from gsstream_lab.report.groups import Group, SweepData, waited
from gsstream_lab.sweep.drive import cell_file

#: Qualities and costs of the curves.
QUALITIES, COSTS = ("psnr_changed", "psnr"), ("kb", "cpu_seconds", "seconds")
#: Columns of the table of all methods.
_KEYS = (
    "psnr_first", "psnr", "psnr_moving", "psnr_changed", "ssim", "kb", "key_kb", "seconds", "cpu_seconds", "memory",
    "seconds_first", "fps", "gaussians",
)  # fmt: skip
_CHANGED = (
    "Changed pixels are those of the ground truth that differ from frame 0 by more than 0.1: what moved, without "
    "shadows and rims. KB are bytes of the packets on disk, 1,000 each, without the key packet, which stands in a "
    "column of its own and holds the same scene for all. All streams are decoded by the same player."
)


def build_page(folder: Path, data: SweepData, source: FrameSource | None) -> list[Block]:
    """Return the blocks of the page, in reading order."""
    groups = list(data.groups)
    blocks: list[Block] = [Text(data.config["description"]), *where_it_ran(data), Text(_CHANGED)]
    costs = [key for key in COSTS if key != "seconds" or not waited(groups)]
    title = f"{data.scenes[0]}: quality against cost"
    blocks += [
        Heading("Quality against cost"),
        Picture("curves.png", pareto_figure(groups, title, QUALITIES, costs, joined=True),
                "PSNR on changed pixels and on the whole image against KB and seconds a frame"),
        all_runs(groups, [key for key in _KEYS if key in data.measured()]),
        _playing(folder, groups),
        Heading("Frame by frame"),
        Picture("frames.png", frame_curves(groups, f"{data.scenes[0]}, seed {groups[0].runs[0].seed}"),
                "Quality, bytes and seconds of every frame"),
    ]  # fmt: skip
    if source is not None:
        streams = {group.label: cell_file(folder, group.runs[0].id) for group in groups}
        sheet, video, camera = picture_files(streams, source)
        text = f"Held-out camera {camera}: the last frame, then what changed most close up, with PSNR on changed pixels"
        blocks += [
            Heading("Pictures"), Picture("pictures.jpg", sheet, text),
            Heading("Video"), Picture("video.webp", video, f"Every frame from camera {camera}"),
        ]  # fmt: skip
    if data.failed:
        rows = [["method", "reason"], *([label, reason.splitlines()[0]] for label, reason in data.failed.items())]
        blocks += [Heading("Failed"), Table("Runs that failed", rows)]
    return blocks


def decode_milliseconds(stream: Path) -> float:
    """Measure the milliseconds that the player takes to decode a frame after the first, mean over the stream."""
    with Playback(stream) as playback:
        first, *later = playback.frames
        playback.state_at(first)
        started = time.perf_counter()
        for frame in later:
            playback.state_at(frame)
        return 1000 * (time.perf_counter() - started) / max(1, len(later))


def _playing(folder: Path, groups: Sequence[Group]) -> Table:
    rows = [["method", "decoding, ms/frame", "stream, KB"]]
    for group in groups:
        file = cell_file(folder, group.runs[0].id)
        rows.append([group.label, f"{decode_milliseconds(file):.1f}", f"{file.stat().st_size / 1000:.0f}"])
    return Table("Playing the first seed here, when this page was made: decoding alone, without drawing", rows)
