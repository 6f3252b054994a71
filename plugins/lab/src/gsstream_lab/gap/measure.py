"""The gap: how far a stream lies behind fresh reconstructions of its own frames, from the same cameras."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsstream.core.errors import InputError
from gsstream.core.shapes import FloatArray
from gsstream.evaluation.records import finite_or_none, mean
from gsstream.evaluation.seen import seen_masks
from gsstream.evaluation.summary import format_table
from gsstream.input.recordings.base import Source
from gsstream.metrics import changed_mask, moving_mask, noise_sigma, psnr
from gsstream.player.playback import Playback
from gsstream.player.render import PlayerRenderer, find_renderer, render

#: What ``gsstream gap`` writes into the folder of a run: the table, and every number behind it.
GAP_FILES = ("gap.txt", "gap.json")
_QUANTITIES = {
    "psnr": "whole",
    "psnr_moving": "moving",
    "psnr_changed": "changed",
    "psnr_seen": "seen",
    "psnr_changed_seen": "changed, seen",
}


@dataclass(frozen=True, slots=True)
class GapView:
    """One test camera at one frame. PSNR of the stream and of the fresh reconstruction, dB; nan where not defined.

    ``psnr``: the whole image. ``psnr_moving``, ``psnr_changed``: moving and changed pixels. ``psnr_seen``,
    ``psnr_changed_seen``: all and changed pixels whose surface, by the fresh reconstruction's depth, at least two
    training cameras see.
    """

    frame: int
    camera: str
    psnr: float
    psnr_moving: float
    psnr_changed: float
    psnr_seen: float
    psnr_changed_seen: float
    fresh_psnr: float
    fresh_psnr_moving: float
    fresh_psnr_changed: float
    fresh_psnr_seen: float
    fresh_psnr_changed_seen: float


@dataclass(frozen=True)
class Gap:
    """What a gap was measured on; ``files``: frame -> stream of its fresh reconstruction, of at most ``epochs``."""

    views: tuple[GapView, ...]
    files: Mapping[int, Path]
    epochs: int

    def mean(self, quantity: str, frame: int | None = None) -> float:
        """Return a quantity's mean over cameras, then over frames, dB."""
        if quantity.startswith("gap_"):
            name = quantity.removeprefix("gap_")
            frames = self.files if frame is None else (frame,)
            return mean(self.mean(f"fresh_{name}", t) - self.mean(name, t) for t in frames)
        wanted = self.files if frame is None else (frame,)
        return mean(mean(getattr(v, quantity) for v in self.views if v.frame == t) for t in wanted)

    def table(self) -> str:
        """Return a Markdown table: a row for each frame and one for their mean; "-" where nothing moves or changed."""
        columns = [prefix + name for name in _QUANTITIES for prefix in ("", "fresh_", "gap_")]
        head = [f"{what} {which}" for what in _QUANTITIES.values() for which in ("stream", "fresh", "gap")]
        rows = [["frame", *head]]
        for frame in (*self.files, *((None,) if len(self.files) > 1 else ())):
            values = [self.mean(column, frame) for column in columns]
            rows.append(["mean" if frame is None else str(frame), *map(_cell, values, columns)])
        held_out = ", ".join(dict.fromkeys(view.camera for view in self.views))
        note = f"PSNR in dB, test cameras: {held_out}; fresh: that frame alone, up to {self.epochs} epochs"
        return f"{format_table(rows)}\n\n{note}"

    def to_json(self) -> str:
        """Return everything as JSON; what is not defined is null."""

        def gaps(frame: int | None) -> dict[str, Any]:
            return {name: finite_or_none(self.mean(f"gap_{name}", frame)) for name in _QUANTITIES}

        data = {
            "gap": {str(frame): gaps(frame) for frame in self.files},
            "mean": gaps(None),
            "epochs": self.epochs,
            "files": {str(frame): str(path) for frame, path in self.files.items()},
            "views": [{key: finite_or_none(value) for key, value in asdict(view).items()} for view in self.views],
        }
        return json.dumps(data, indent=1, allow_nan=False)


def measure_gap(
    stream: Path,
    fresh: Mapping[int, Path],
    source: Source,
    epochs: int,
    *,
    renderer: PlayerRenderer | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Gap:
    """Render frames of a stream and of their fresh reconstructions for the test cameras, and compare them.

    Moving and changed pixels are those against the stream's first frame; noise is measured between its first two.
    """
    renderer = find_renderer() if renderer is None else renderer
    cameras = source.info.test.ids
    if not cameras:
        raise InputError("the recording has no test cameras, so there is nothing to compare with (data.test_cameras)")
    views: list[GapView] = []
    with Playback(stream) as playback:
        first = source.frame(playback.frames[0], "test").images
        second = source.frame(playback.frames[min(1, len(playback) - 1)], "test").images
        sigmas = [noise_sigma(a, b) for a, b in zip(first, second, strict=True)]
        for done, (frame, path) in enumerate(fresh.items(), 1):
            truth = source.frame(frame, "test").images
            mine = _pictures(playback, frame, renderer)
            with Playback(path) as alone:
                theirs = _pictures(alone, frame, renderer)
                seen = seen_masks(alone.state_at(frame), alone.meta.train, alone.meta.test, renderer)
            for i, name in enumerate(cameras):
                moving, changed = moving_mask(truth[i], first[i], sigmas[i]), changed_mask(truth[i], first[i])
                masks = (None, moving, changed, seen[i], changed & seen[i])
                found = [psnr(image[i], truth[i], mask) for image in (mine, theirs) for mask in masks]
                views.append(GapView(frame, name, *found))
            if progress is not None:
                progress(done, len(fresh))
    return Gap(tuple(views), dict(fresh), epochs)


def default_frames(frames: Sequence[int]) -> list[int]:
    """Return a third, two thirds and the end of a stream's frames, where a gap is measured by default."""
    last = len(frames) - 1
    return sorted({frames[round(share * last)] for share in (1 / 3, 2 / 3, 1)})


def _pictures(playback: Playback, frame: int, renderer: PlayerRenderer) -> list[FloatArray]:
    scene, meta = playback.state_at(frame), playback.meta
    return [
        np.clip(render(scene, meta.test, i, background=meta.background, renderer=renderer), 0, 1)
        for i in range(len(meta.test))
    ]


def _cell(value: float, column: str) -> str:
    if not math.isfinite(value):
        return "-"
    return f"{value:+.2f}" if column.startswith("gap_") else f"{value:.2f}"
