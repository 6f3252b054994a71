"""Pictures of several streams beside one another and the ground truth: a sheet, and a video as an animated picture."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from gsstream.core.shapes import FloatArray
from gsstream.evaluation.contact_sheet import most_changed_window
from gsstream.evaluation.evaluate import StreamFrames
from gsstream.input.recordings.base import FrameSource
from gsstream.metrics import changed_mask, psnr
from gsstream.player.play import write_pictures
from gsstream.player.playback import Playback
from gsstream.player.render import find_renderer, to_bytes

TRUTH = "ground truth"
_LINE, _GAP = 15, 4
#: Least width of a tile, in pixels: smaller pictures are enlarged by a whole number.
_WIDTH = 200
Bytes = np.ndarray[Any, np.dtype[np.uint8]]


@dataclass(frozen=True, slots=True)
class Tile:
    """A picture [H, W, 3] in [0, 1] and the two lines above it."""

    title: str
    image: FloatArray


def tiles_in_rows(rows: Sequence[Sequence[Tile]]) -> Bytes:
    """Return one picture [H, W, 3] uint8: rows of tiles, each under its title."""
    heights = [max(tile.image.shape[0] for tile in row) + 2 * _LINE + _GAP for row in rows]
    width = max(sum(tile.image.shape[1] + _GAP for tile in row) for row in rows)
    sheet = Image.new("RGB", (width, sum(heights)), "white")
    draw, font, top = ImageDraw.Draw(sheet), ImageFont.load_default(size=12), 0
    for row, height in zip(rows, heights, strict=True):
        left = 0
        for tile in row:
            draw.multiline_text((left + 2, top), tile.title, "black", font, spacing=1)
            sheet.paste(Image.fromarray(to_bytes(tile.image)), (left, top + 2 * _LINE))
            left += tile.image.shape[1] + _GAP
        top += height
    return np.asarray(sheet)


class SideBySide:
    """Streams of one recording, seen from its first test camera."""

    def __init__(self, streams: Mapping[str, Path], source: FrameSource) -> None:
        self._stack = ExitStack()
        renderer = find_renderer()
        self.shown: dict[str, StreamFrames] = {}
        for name, path in streams.items():
            playback = self._stack.enter_context(Playback(path))
            rig = playback.meta.camera(playback.meta.test.ids[0])
            self.shown[name] = StreamFrames(playback, rig, renderer)
        one = next(iter(self.shown.values()))
        self.camera, self.frames = one.rig.ids[0], one.frames
        self._source, self._place = source, source.info.test.ids.index(self.camera)

    def __enter__(self) -> SideBySide:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def truth(self, frame: int) -> FloatArray:
        """Return [H, W, 3] what the camera recorded in a frame."""
        return np.asarray(self._source.frame(frame, "test").images[self._place])

    def row(self, frame: int, close: tuple[slice, slice] | None = None) -> list[Tile]:
        """Return the ground truth of a frame and what every stream shows of it."""
        truth, first = self.truth(frame), self.truth(self.frames[0])
        part = (slice(None), slice(None)) if close is None else close
        mask = None if close is None else changed_mask(truth, first)
        tiles = [Tile(f"frame {frame}\n{TRUTH}", _enlarged(truth[part]))]
        for name, shown in self.shown.items():
            image = shown.images(frame)[0]
            tiles.append(Tile(f"{name}\n{psnr(image, truth, mask):.2f} dB", _enlarged(image[part])))
        return tiles

    def sheet(self) -> Bytes:
        """Return the last frame whole, then what changed most since the first one close up in three frames."""
        number = len(self.frames)
        chosen = list(dict.fromkeys(self.frames[i] for i in (number // 3, 2 * number // 3, number - 1)))
        first, last = self.truth(self.frames[0]), self.frames[-1]
        rows = [*_lines(self.row(last), 4)]
        for frame in chosen:
            close = most_changed_window(self.truth(frame), first)
            if close is not None:
                rows += _lines(self.row(frame, close), 5)
        return tiles_in_rows(rows)

    def video(self, out: Path, fps: float) -> bytes:
        """Write every frame of every stream side by side as an animated WebP and return its bytes."""

        def pictures() -> Iterator[Bytes]:
            for frame in self.frames:
                tiles = self.row(frame)
                # The PSNR of a frame flickers too fast to be read: names alone.
                named = [Tile(name, tile.image) for name, tile in zip((TRUTH, *self.shown), tiles, strict=True)]
                yield tiles_in_rows(_lines(named, 3))

        write_pictures(out, pictures(), self.frames, fps)
        return out.read_bytes()


def picture_files(streams: Mapping[str, Path], source: FrameSource) -> tuple[bytes, bytes, str]:
    """Return the sheet (JPEG), the video (WebP) and the camera that both are seen from."""
    with tempfile.TemporaryDirectory() as folder, SideBySide(streams, source) as together:
        sheet = Path(folder) / "sheet.jpg"
        Image.fromarray(together.sheet()).save(sheet, quality=90)
        video = together.video(Path(folder) / "video.webp", source.info.fps)
        return sheet.read_bytes(), video, together.camera


def _lines(tiles: Sequence[Tile], most: int) -> list[Sequence[Tile]]:
    return [tiles[i : i + most] for i in range(0, len(tiles), most)]


def _enlarged(image: FloatArray) -> FloatArray:
    zoom = -(-_WIDTH // image.shape[1])
    return image.repeat(zoom, 0).repeat(zoom, 1)
