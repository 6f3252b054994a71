"""Pictures of a scene's streams: a contact sheet of one, and all beside one another and the ground truth."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from gsstream.core.shapes import FloatArray
from gsstream.discovery.catalog import load_catalog
from gsstream.engine.run.recording import reopen_recording
from gsstream.evaluation.contact_sheet import most_changed_window, sheet_of_stream
from gsstream.evaluation.evaluate import StreamFrames
from gsstream.input.recordings.base import Source
from gsstream.metrics import changed_mask, psnr
from gsstream.player.play import write_pictures
from gsstream.player.playback import Playback
from gsstream.player.render import find_renderer, to_bytes
from gsstream_lab.jobs.folder import recording_uri
from gsstream_lab.report.document import Block, Picture, Table
from gsstream_lab.report.groups import SweepData
from gsstream_lab.sweep.drive import cell_file
from gsstream_lab.sweep.plan import disturbed_uri

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

    def __init__(self, streams: Mapping[str, Path], source: Source) -> None:
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


@contextmanager
def recording_of(data: SweepData, scene: str, recordings: Path | None) -> Iterator[Source]:
    """Open the recording of a scene as its first run saw it. Raises InputError where it cannot be found."""
    group = data.of(scene)[0]
    run = group.runs[0]
    uri = next(one["uri"] for one in data.config["scenes"] if one["name"] == scene)
    variant = next(one for one in data.config["variants"] if one["name"] == group.variant)
    uri = recording_uri(disturbed_uri(uri, variant.get("disturbed"), run.seed), recordings)
    source = reopen_recording(uri, data.table.recipes[run.row["recipe"]]["values"], load_catalog())
    try:
        yield source
    finally:
        source.close()


def contact_sheet(folder: Path, data: SweepData, scene: str, source: Source) -> list[Block]:
    """Return the contact sheet of the first run of a scene: what it shows, its errors, what was allowed to change."""
    group = data.of(scene)[0]
    run = group.runs[0]
    frames = sorted({0, len(run.records) // 2, len(run.records) - 1})
    with tempfile.TemporaryDirectory() as temporary:
        sheet = sheet_of_stream(cell_file(folder, run.id), source, frames, Path(temporary) / "sheet.jpg").read_bytes()
    text = f"{group.label} on {scene}: ground truth, decoded, error, what was allowed to change"
    return [f"### {scene}: pictures", Picture(f"{scene}-sheet.jpg", sheet, text)]


def side_by_side(folder: Path, data: SweepData, scene: str, source: Source) -> list[Block]:
    """Return a sheet and a video of the first seed of every group, seen from the first test camera."""
    streams = {group.label: cell_file(folder, group.runs[0].id) for group in data.of(scene)}
    with tempfile.TemporaryDirectory() as temporary, SideBySide(streams, source) as together:
        sheet = Path(temporary) / "sheet.jpg"
        Image.fromarray(together.sheet()).save(sheet, quality=90)
        video = together.video(Path(temporary) / "video.webp", source.info.fps)
        text = f"Camera {together.camera}: the last frame, then what changed most close up, with PSNR on changed pixels"
        return [
            "### Pictures",
            Picture("pictures.jpg", sheet.read_bytes(), text),
            "### Video",
            Picture("video.webp", video, f"Every frame from camera {together.camera}"),
        ]


def decoding(folder: Path, data: SweepData, scene: str) -> Table:
    """Return what the player takes here to decode a frame after the first of the first seed of every group."""
    rows = [["method", "decoding, ms/frame", "stream, KB"]]
    for group in data.of(scene):
        file = cell_file(folder, group.runs[0].id)
        with Playback(file) as playback:
            first, *later = playback.frames
            playback.state_at(first)
            started = time.perf_counter()
            for frame in later:
                playback.state_at(frame)
            spent = 1000 * (time.perf_counter() - started) / max(1, len(later))
        rows.append([group.label, f"{spent:.1f}", f"{file.stat().st_size / 1000:.0f}"])
    return Table("Playing the first seed here, when this page was made: decoding alone, without drawing", rows)


def _lines(tiles: Sequence[Tile], most: int) -> list[Sequence[Tile]]:
    return [tiles[i : i + most] for i in range(0, len(tiles), most)]


def _enlarged(image: FloatArray) -> FloatArray:
    zoom = -(-_WIDTH // image.shape[1])
    return image.repeat(zoom, 0).repeat(zoom, 1)
