"""Contact sheet: frames side by side; below each other ground truth, decoded image, error and changed Gaussians.

Below them, close up, what changed most since the first frame: ground truth, decoded, and the fresh reconstruction of
the frame where there is one.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from gsstream.core.cameras import Cameras
from gsstream.core.changes import row_gates
from gsstream.core.errors import InputError
from gsstream.core.gaussians import SH0, Gaussians
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.base import Source
from gsstream.metrics import changed_mask, psnr
from gsstream.packet import PlayerState
from gsstream.player.playback import Playback
from gsstream.player.render import PlayerRenderer, render, to_bytes

#: Errors are shown this much larger than they are.
ERROR_GAIN = 4
_CLOSED, _OPEN = (0.25, 0.27, 0.30), (1.0, 0.55, 0.0)
_MARGIN, _GAP, _TEXT = 8, 4, 18
#: Close-ups are enlarged by this factor: they show one CLOSER-th of a picture's width and height.
CLOSER = 3
#: Pictures of a sheet are at most so wide, pixels: large ones are reduced by a whole number.
WIDEST = 480
_LABELS = (
    "ground truth",
    "decoded",
    f"|error| x {ERROR_GAIN}",
    "allowed to change",
    "ground truth, close",
    "decoded, close",
    "fresh, close",
)


@dataclass(frozen=True, slots=True)
class Column:
    """One frame: ``truth``, ``decoded`` [H, W, 3] in [0, 1]; ``active`` and ``fresh`` the same or None.

    ``close``: rows and columns of the part that is shown close up; None: nothing changed.
    """

    title: str
    truth: FloatArray
    decoded: FloatArray
    active: FloatArray | None = None
    fresh: FloatArray | None = None
    close: tuple[slice, slice] | None = None

    @property
    def pictures(self) -> tuple[FloatArray | None, ...]:
        """The pictures of a column, in the order of ``_LABELS``."""
        error = np.abs(self.truth - np.clip(self.decoded, 0, 1)) * ERROR_GAIN
        close = [
            None if self.close is None or i is None else _enlarged(i[self.close])
            for i in (self.truth, self.decoded, self.fresh)
        ]
        return (self.truth, self.decoded, error, self.active, *close)


def contact_sheet(columns: Sequence[Column], heading: str = "") -> Image.Image:
    """Draw the sheet under a heading; images of at most 480 pixels of width keep their pixels.

    Raises InputError for an empty list.
    """
    if not columns:
        raise InputError("a contact sheet needs at least one frame")
    factor = -(-columns[0].truth.shape[1] // WIDEST)
    height, width = (max(1, side // factor) for side in columns[0].truth.shape[:2])
    pictures = [[_reduced(picture, factor) for picture in column.pictures] for column in columns]
    # Rows that no column has a picture for are left out.
    shown = [row for row in range(len(_LABELS)) if any(column[row] is not None for column in pictures)]
    labels = [_LABELS[row] for row in shown]
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
        for row, which in enumerate(shown):
            if (image := pictures[index][which]) is not None:
                sheet.paste(Image.fromarray(to_bytes(image)), (x, top + row * (height + _GAP)))
    return sheet


def sheet_of_stream(
    stream: str | os.PathLike[str],
    source: Source,
    frames: Sequence[int],
    out: str | os.PathLike[str],
    *,
    camera: str | None = None,
    renderer: PlayerRenderer | None = None,
    fresh: Mapping[int, Path] | None = None,
) -> Path:
    """Render a contact sheet of a stream's frames against its recording and save it as PNG.

    Raises InputError for an unknown camera or frame.
    """
    with Playback(stream) as playback:
        meta = playback.meta
        rig = meta.camera((*meta.test.ids, *meta.train.ids)[0] if camera is None else camera)
        split: Any = "test" if rig.ids[0] in meta.test.ids else "train"
        recorded = source.info.test if split == "test" else source.info.train
        if rig.ids[0] not in recorded.ids:
            raise InputError(f"camera {rig.ids[0]!r} is not in the recording, which has {list(recorded.ids)}")
        columns, place = [], recorded.ids.index(rig.ids[0])
        first = source.frame(playback.frames[0], split).images[place]
        for frame in frames:
            state = playback.player_state(frame)
            image = np.clip(render(state.gaussians, rig, 0, background=state.meta.background, renderer=renderer), 0, 1)
            truth = source.frame(frame, split).images[place]
            painted = paint_gates(state)
            active = (
                None
                if frame == playback.frames[0]
                else render(painted, rig, 0, background=(0.0, 0.0, 0.0), renderer=renderer)
            )
            alone = _alone(fresh[frame], frame, rig, renderer) if fresh and frame in fresh else None
            title = f"frame {frame}   {psnr(image, truth):.2f} dB"
            columns.append(
                Column(
                    title=title,
                    truth=truth,
                    decoded=image,
                    active=active,
                    fresh=alone,
                    close=most_changed_window(truth, first),
                )
            )
    out = Path(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    contact_sheet(columns, f"{meta.title} on {meta.source}, camera {rig.ids[0]}").save(out)
    return out


def most_changed_window(truth: FloatArray, first: FloatArray) -> tuple[slice, slice] | None:
    """Return rows and columns of the window with the most changed pixels; None when there are none."""
    changed = changed_mask(truth, first)
    if not changed.any():
        return None
    height, width = (max(1, side // CLOSER) for side in changed.shape)
    # Sums over all windows, by differences of a two-dimensional running sum.
    total = np.pad(changed.astype(np.int64).cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    inside = total[height:, width:] - total[:-height, width:] - total[height:, :-width] + total[:-height, :-width]
    top, left = (int(i) for i in np.unravel_index(inside.argmax(), inside.shape))
    return slice(top, top + height), slice(left, left + width)


def _enlarged(image: FloatArray) -> FloatArray:
    return image.repeat(CLOSER, 0).repeat(CLOSER, 1)


def _reduced(image: FloatArray | None, factor: int) -> FloatArray | None:
    """A picture ``factor`` times smaller, means over squares; a close-up was enlarged, so it keeps its own pixels."""
    if image is None or factor == 1:
        return image
    height, width = (max(1, side // factor) for side in image.shape[:2])
    cut = np.clip(image[: height * factor, : width * factor], 0, 1)
    return np.asarray(cut.reshape(height, -1, width, cut.shape[1] // width, 3).mean((1, 3)))


def _alone(path: Path, frame: int, rig: Cameras, renderer: PlayerRenderer | None) -> FloatArray:
    """The picture of a frame's fresh reconstruction as a camera sees it."""
    with Playback(path) as playback:
        return np.clip(
            render(playback.state_at(frame), rig, 0, background=playback.meta.background, renderer=renderer), 0, 1
        )


def paint_gates(state: PlayerState) -> Gaussians[FloatArray]:
    """Return the scene in two colours: Gaussians that the frame changed are orange by gate value, others grey."""
    gaussians = state.gaussians
    share: FloatArray = np.zeros(len(gaussians), np.float32)
    if state.delta is not None and state.before is not None:
        share = row_gates(state.before, state.delta)
        if state.scene.displacement is not None and not state.delta.has_row_edit:
            share[state.scene.displacement.rows] = 1.0
    closed, opened = np.array(_CLOSED), np.array(_OPEN)
    color = closed + share[:, None] * (opened - closed)
    return Gaussians(
        means=gaussians.means,
        quats=gaussians.quats,
        scales=gaussians.scales,
        opacities=gaussians.opacities,
        sh0=((color - 0.5) / SH0)[:, None].astype(np.float32),
        shN=np.zeros_like(gaussians.shN),
    )


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
