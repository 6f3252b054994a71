"""Which Gaussians stay behind the body that they belong to: a diagnosis of a finished stream."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.changes.rows import gather_rows
from gsstream.core.frame import Frame
from gsstream.core.projection import inside, project
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.core.storage import unpacked
from gsstream.engine.run.displacement import screen_displacement
from gsstream.input.recordings.base import Source
from gsstream.metrics.moving import changed_mask, dilate
from gsstream.packet import PacketKind, PlayerState, StreamReader, decode_packet

#: Raw opacity below which a Gaussian is not looked for: it shows less than a tenth of its colour.
FAINT = -2.2
#: Distance on the screen below which a Gaussian counts as not moved, pixels.
UNMOVED = 1.0
#: Least number of cameras that must see a body: fewer do not say where a point of it lies.
LEAST_CAMERAS = 2
#: Share of the cameras with a point in their picture that must see a change there: what moves may have by chance the
#: colour that was there before.
MOST = 0.75


def left_behind(stream: Path, source: Source) -> Iterator[tuple[int, dict[str, int]]]:
    """Yield (frame, counts) of every frame of a stream; the counts begin anew at each key packet."""
    found, state = LeftBehind(), None
    with StreamReader(stream) as reader:
        for entry in reader.frames:
            state = decode_packet(state, reader.read(entry))
            yield state.frame, found.after(state, source.frame(state.frame), entry.kind == PacketKind.KEY)


@dataclass
class LeftBehind:
    """Follows the Gaussians of the last key frame, and counts those that did not go with their body.

    A Gaussian belongs to a moving body when its place in the key frame lies in the visual hull of what has changed
    since: three quarters of the cameras that have it in their picture, and two at least, see a changed pixel there (0.1
    in some channel, and one pixel around). It is *outside* when its place now is not in that hull, so that it stands
    where the body has been on its way; *unmoved* when it has gone less than a pixel, so that it stands where the body
    was. What turns in place, and shadows, count as unmoved, too: compare runs on one recording, not recordings.
    """

    _images: FloatArray = field(default_factory=lambda: np.zeros((0, 0, 0, 3), np.float32))
    _places: FloatArray = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    #: Row of the key frame of every row now; -1: added since.
    _rows: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))

    def after(self, player: PlayerState, frame: Frame, is_key: bool) -> dict[str, int]:
        """Return what :meth:`measure` finds in a frame, once its rows are followed."""
        self.follow(player, frame if is_key else None)
        return self.measure(player, frame)

    def follow(self, player: PlayerState, key: Frame | None) -> None:
        """Keep track of rows while Gaussians are added and removed."""
        if key is not None:
            visible = player.gaussians.opacities.reshape(-1) > FAINT
            self._images = np.rint(255 * np.clip(key.images, 0, 1)).astype(np.uint8)
            self._places = player.gaussians.means
            self._rows = np.where(visible, np.arange(len(visible)), -1)
            return
        delta = player.delta
        if delta is None or not delta.has_row_edit or player.before is None:
            return
        source = gather_rows(player.before.node_of, delta.added, delta.removed)
        self._rows = np.append(self._rows, -1)[np.minimum(source, len(self._rows))]

    def measure(self, player: PlayerState, frame: Frame) -> dict[str, int]:
        """Return how many Gaussians belong to moving bodies, and how many of them are outside or unmoved."""
        changed = [
            dilate(changed_mask(image, first), 1)
            for image, first in zip(frame.images, unpacked(self._images), strict=True)
        ]
        now = np.flatnonzero(self._rows >= 0)
        start, end = self._places[self._rows[now]], player.gaussians.means[now]
        body = in_hull(start, frame.cameras, changed)
        start, end = start[body], end[body]
        outside = ~in_hull(end, frame.cameras, changed)
        unmoved = ~outside & (screen_displacement(start, end, frame.cameras) < UNMOVED)
        return {"body": len(start), "outside": int(outside.sum()), "unmoved": int(unmoved.sum())}


def in_hull(points: FloatArray, cameras: Cameras, masks: list[Any]) -> Any:
    """Return [P] bool: most cameras that have a point in their picture, and two at least, see a marked pixel there."""
    marked, seen = np.zeros(len(points), np.int64), np.zeros(len(points), np.int64)
    for view, mask in enumerate(masks):
        uv, depth = project(points, cameras, view)
        there = inside(uv, depth, cameras)
        column, row = uv[there].astype(np.int64).T
        marked[there] += mask[row, column]
        seen += there
    return (marked >= MOST * seen) & (marked >= LEAST_CAMERAS)
