"""Contact sheet: frames side by side; ground truth, decoded, error and what was allowed to change below each other."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from gsstream.core.changes import row_gates
from gsstream.core.errors import InputError
from gsstream.core.gaussians import SH0, Gaussians
from gsstream.core.shapes import FloatArray
from gsstream.metrics import psnr
from gsstream.packet import PlayerState
from gsstream.player.playback import Playback
from gsstream.player.render import PlayerRenderer, render, to_bytes
from gsstream.source.base import FrameSource

#: Errors are shown this much larger than they are.
ERROR_GAIN = 4
_CLOSED, _OPEN = (0.25, 0.27, 0.30), (1.0, 0.55, 0.0)
_MARGIN, _GAP, _TEXT = 8, 4, 18


@dataclass(frozen=True, slots=True)
class Column:
    """One frame: ``truth``, ``decoded`` [H, W, 3] in [0, 1]; ``active`` the same or None."""

    title: str
    truth: FloatArray
    decoded: FloatArray
    active: FloatArray | None = None


def contact_sheet(columns: Sequence[Column], heading: str = "") -> Image.Image:
    """Draw the sheet under a heading; images keep their pixels. Raises InputError for an empty list."""
    if not columns:
        raise InputError("a contact sheet needs at least one frame")
    height, width = columns[0].truth.shape[:2]
    labels = ["ground truth", "decoded", f"|error| x {ERROR_GAIN}"]
    labels += ["allowed to change"] if any(c.active is not None for c in columns) else []
    left = 2 * _MARGIN + max(int(_font().getlength(label)) for label in labels)
    right = left + len(columns) * (width + _GAP) + _MARGIN
    said = _wrapped(heading, right - 2 * _MARGIN)
    top = _TEXT * (1 + len(said))
    size = (right, top + len(labels) * (height + _GAP) + _MARGIN)
    sheet = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(sheet)
    for number, line in enumerate(said):
        draw.text((_MARGIN, 3 + number * _TEXT), line, "black", _font())
    for row, label in enumerate(labels):
        draw.text((_MARGIN, top + row * (height + _GAP) + height // 2 - 6), label, "black", _font())
    for index, column in enumerate(columns):
        x = left + index * (width + _GAP)
        draw.text((x, top - _TEXT + 3), column.title, "black", _font())
        error = np.abs(column.truth - np.clip(column.decoded, 0, 1)) * ERROR_GAIN
        for row, image in enumerate((column.truth, column.decoded, error, column.active)):
            if image is not None:
                sheet.paste(Image.fromarray(to_bytes(image)), (x, top + row * (height + _GAP)))
    return sheet


def sheet_of_stream(
    stream: str | os.PathLike[str], source: FrameSource, frames: Sequence[int], out: str | os.PathLike[str], *,
    camera: str | None = None, renderer: PlayerRenderer | None = None,
) -> Path:  # fmt: skip
    """Render a contact sheet of a stream's frames against its recording and save it as PNG.

    Arguments:
        stream: file to read.
        source: an open recording.
        frames: to show.
        out: picture to write.
        renderer: that draws.
        camera: id of a test or train camera; default the first test camera.

    Raises InputError for an unknown camera or frame.
    """
    with Playback(stream) as playback:
        meta = playback.meta
        rig = meta.camera((*meta.test.ids, *meta.train.ids)[0] if camera is None else camera)
        split: Any = "test" if rig.ids[0] in meta.test.ids else "train"
        recorded = source.info.test if split == "test" else source.info.train
        if rig.ids[0] not in recorded.ids:
            raise InputError(f"camera {rig.ids[0]!r} is not in the recording, which has {list(recorded.ids)}")
        columns = []
        for frame in frames:
            state = playback.player_state(frame)
            image = np.clip(render(state.gaussians, rig, 0, meta.background, renderer), 0, 1)
            truth = source.frame(frame, split).images[recorded.ids.index(rig.ids[0])]
            painted = paint_gates(state)
            active = None if frame == playback.frames[0] else render(painted, rig, 0, (0.0, 0.0, 0.0), renderer)
            columns.append(Column(f"frame {frame}   {psnr(image, truth):.2f} dB", truth, image, active))
    out = Path(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    contact_sheet(columns, f"{meta.title} on {meta.source}, camera {rig.ids[0]}").save(out)
    return out


def paint_gates(state: PlayerState) -> Gaussians[FloatArray]:
    """Return the scene in two colours: orange what the frame moved or let change, by gate value, grey the rest."""
    gaussians = state.gaussians
    share: FloatArray = np.zeros(len(gaussians), np.float32)
    if state.delta is not None and state.before is not None:
        share = row_gates(state.before, state.delta)
        if state.scene.moved is not None and not state.delta.edits_rows:
            share[state.scene.moved.rows] = 1.0
    closed, opened = np.array(_CLOSED), np.array(_OPEN)
    color = closed + share[:, None] * (opened - closed)
    return Gaussians(
        gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities,
        ((color - 0.5) / SH0)[:, None].astype(np.float32), np.zeros_like(gaussians.shN),
    )  # fmt: skip


def _wrapped(text: str, width: int) -> list[str]:
    """A text in lines of at most ``width`` pixels, broken between words."""
    lines: list[str] = []
    for word in text.split():
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and _font().getlength(longer) <= width:
            lines[-1] = longer
        else:
            lines.append(word)
    return lines


def _font() -> Any:
    return ImageFont.load_default(size=12)
