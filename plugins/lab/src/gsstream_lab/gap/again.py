"""Wear: what a stream loses where its recording shows the same pictures again, as one does that goes there and back."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsstream.core.errors import InputError
from gsstream.core.shapes import BoolArray, FloatArray
from gsstream.evaluation.records import finite_or_none, mean
from gsstream.evaluation.summary import format_table
from gsstream.input.recordings.base import Source
from gsstream.metrics import changed_mask, psnr, slope_per_100
from gsstream.player.playback import Playback
from gsstream.player.render import PlayerRenderer, find_renderer, render

#: Parts of a picture: all of it; what never changes in the whole recording; what changes at other times; what has
#: changed. To change is to differ from the first frame, as *changed pixels* do (docs/conventions.md).
PARTS = ("whole", "still", "came back", "changed")
SLOPE = "dB in 100 frames"


@dataclass(frozen=True)
class Again:
    """PSNR of every frame, mean over test cameras, by the parts of a picture.

    Arguments:
        pictures: for each frame, which of the different pictures it shows; they are counted as they come.
        values: [T, 4] dB, nan where a part is empty.
    """

    pictures: Sequence[int]
    values: FloatArray

    @property
    def ways(self) -> list[list[int]]:
        """Frames of each time that the recording was gone through, without those of pictures shown less often."""
        shown: dict[int, list[int]] = {}
        for frame, picture in enumerate(self.pictures):
            shown.setdefault(picture, []).append(frame)
        number = max(map(len, shown.values()))
        full = sorted(frames for frames in shown.values() if len(frames) == number)
        return [[frames[way] for frames in full] for way in range(number)]

    def rows(self) -> list[tuple[str, list[float]]]:
        """Return each way's mean over its pictures, their slope, and every frame that shows the first picture."""
        ways = [(frames, [mean(column) for column in self.values[frames].T]) for frames in self.ways]
        found = [(f"{min(frames)} to {max(frames)}", values) for frames, values in ways]
        middles = [round(mean(frames)) for frames, _ in ways]
        found.append(
            (SLOPE, [slope_per_100(middles, list(column)) for column in zip(*[v for _, v in ways], strict=True)])
        )
        first = [frame for frame, picture in enumerate(self.pictures) if picture == self.pictures[0]]
        return found + [(f"frame {frame}", self.values[frame].tolist()) for frame in first]

    def table(self) -> str:
        """Return a Markdown table of :meth:`rows`."""
        cells = [
            [name, *("-" if math.isnan(v) else f"{v:+.2f}" if name == SLOPE else f"{v:.2f}" for v in values)]
            for name, values in self.rows()
        ]
        note = (
            "PSNR in dB, means over pictures; the recording shows the pictures of each row of frames again in the next"
        )
        return f"{format_table([['frames', *PARTS], *cells])}\n\n{note}"

    def to_json(self) -> str:
        """Return :meth:`rows` as JSON; what is not defined is null."""
        rows = [
            {"frames": name, **dict(zip(PARTS, map(finite_or_none, values), strict=True))}
            for name, values in self.rows()
        ]
        return json.dumps(rows, indent=1, allow_nan=False)


def measure_again(
    stream: Path,
    source: Source,
    renderer: PlayerRenderer | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Again:
    """Render every frame for the test cameras, and compare it with its pictures by parts.

    Raises InputError where the recording has no test cameras or never shows a picture again.
    """
    renderer = find_renderer() if renderer is None else renderer
    if not source.info.test.ids:
        raise InputError("the recording has no test cameras, so there is nothing to compare with (data.test_cameras)")
    with Playback(stream) as playback:
        frames, meta, values = playback.frames, playback.meta, list[list[float]]()
        pictures, changed = _different(source, frames)
        ever = np.any(changed, axis=0)
        for frame, scene in playback:
            now, views = changed[pictures[len(values)]], list[list[float]]()
            for i, truth in enumerate(source.frame(frame, "test").images):
                image = np.clip(
                    render(scene, meta.test, i, background=playback.meta.background, renderer=renderer), 0, 1
                )
                views.append([psnr(image, truth, mask) for mask in (None, ~ever[i], ever[i] & ~now[i], now[i])])
            values.append([mean(column) for column in zip(*views, strict=True)])
            if progress is not None:
                progress(len(values), len(frames))
    return Again(tuple(pictures), np.array(values))


def _different(source: Source, frames: range) -> tuple[list[int], BoolArray]:
    """Return which of the different pictures each frame shows, and [P, C, H, W] bool: where these changed.

    Raises InputError where all are different.
    """
    known: dict[bytes, int] = {}
    pictures, changed, first = list[int](), list[list[BoolArray]](), source.frame(frames[0], "test").images
    for frame in frames:
        images = source.frame(frame, "test").images
        pictures.append(known.setdefault(hashlib.sha256(images.tobytes()).digest(), len(known)))
        if len(changed) < len(known):
            changed.append([changed_mask(image, before) for image, before in zip(images, first, strict=True)])
    if len(known) == len(pictures):
        raise InputError(
            f"the recording shows none of the pictures of its {len(pictures)} frames again; disturbed:ways=3:URI goes "
            "there and back again"
        )
    return pictures, np.array(changed)
