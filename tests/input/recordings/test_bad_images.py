"""Images that cannot be read stop a run, are repeated, or their frame is dropped, as the options say."""

from __future__ import annotations

import json
import shutil
import struct
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gsstream.core.errors import EndOfRecording, InputError, SourceError
from gsstream.core.memory import limited_memory
from gsstream.input.prepare.raw import find_cameras
from gsstream.input.recordings.base import Wrapped
from gsstream.input.recordings.images import read_image
from gsstream.input.recordings.open import DEMO_FOLDER, open_source
from gsstream.input.recordings.options import DataOptions
from gsstream.input.recordings.sync import RecordingWarning
from gsstream.input.recordings.transformed import transformed
from gsstream.input.recordings.video import VideoClip
from tests.input.recordings.tiny_recordings import write_video
from tests.input.test_doors import bomb, chunk

WORLD = "synthetic:frames=12&views=4&width=16&height=12&supersample=1&motion=3"


@pytest.fixture
def damaged(tmp_path: Path) -> Path:
    """The demo; one training image and one test image of frames 3 and 5 are cut short, the latter in two frames."""
    folder = tmp_path / "demo"
    shutil.copytree(DEMO_FOLDER, folder)
    cameras = json.loads((folder / "cameras.json").read_text())["cameras"]
    train, test = (next(c for c in cameras if c["split"] == split) for split in ("train", "test"))
    for camera, frames in ((train, (3, 4)), (test, (5,))):
        for index in frames:
            path = folder / (camera["frames"] % index)
            path.write_bytes(path.read_bytes()[:200])
    return folder


def test_by_default_a_bad_image_stops_with_its_name(damaged) -> None:
    for options in ({}, {"leak": "points"}):
        source = transformed(open_source(str(damaged)), DataOptions(**options))
        assert source.frame(2).images.shape[0] > 1
        with pytest.raises(SourceError, match="000003"):
            source.frame(3)


@pytest.mark.parametrize("policy", ["repeat", "drop"])
def test_a_bad_image_is_repeated_or_its_frame_dropped(policy, damaged) -> None:
    whole, source = open_source("demo"), transformed(open_source(str(damaged)), DataOptions(bad_image=policy))
    for index in range(7):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            frame, test = source.frame(index), source.frame(index, "test")
        bad = index in (3, 4)
        expected = whole.frame(index).images.copy()
        if bad:
            expected[0] = whole.frame(2).images[0]
        assert np.array_equal(frame.images, expected)
        assert frame.epoch_scale == (0.0 if bad and policy == "drop" else 1.0)
        assert len(test.cameras) == len(test.images) == (0 if index == 5 else len(whole.info.test))
        words = " ".join(str(w.message) for w in told if issubclass(w.category, RecordingWarning))
        assert (f"frame {index}, camera" in words) == (bad or index == 5)


def header(side: int, depth: int, colour: int) -> Callable[[Path], None]:
    """A picture of this many pixels, as its header says, and none behind it."""
    first = struct.pack(">IIBBBBB", side, side, depth, colour, 0, 0, 0)
    data = chunk(b"IHDR", first) + chunk(b"IDAT", zlib.compress(b"\0")) + chunk(b"IEND", b"")
    return lambda path: path.write_bytes(b"\x89PNG\r\n\x1a\n" + data) and None


def packed_chunk(kind: bytes) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        Image.open(path).save(path, format="PNG")
        bomb(kind, b"k\0\0")(path)

    return change


BOMBS = {
    "text": packed_chunk(b"zTXt"),
    "profile": packed_chunk(b"iCCP"),
    "13,000 x 13,000": header(13_000, 8, 2),
    "20,000 x 20,000": header(20_000, 8, 6),
    "of 16 bits": header(20_000, 16, 2),
    "grey, of 16 bits": header(12_000, 16, 0),
}


@pytest.mark.parametrize("kind", BOMBS)
@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
def test_a_picture_that_unpacks_to_much_is_passed_over_as_any_bad_image(kind: str, tmp_path: Path) -> None:
    folder = tmp_path / "demo"
    shutil.copytree(DEMO_FOLDER, folder)
    camera = json.loads((folder / "cameras.json").read_text())["cameras"][0]
    BOMBS[kind](folder / (camera["frames"] % 3))
    whole, source = open_source("demo"), transformed(open_source(str(folder)), DataOptions(bad_image="repeat"))
    with pytest.warns(RecordingWarning, match="frame 3, camera"):
        frame = source.frame(3)
    row = frame.cameras.ids.index(camera["id"])
    assert np.array_equal(frame.images[row], whole.frame(2).images[row])
    with pytest.raises(SourceError, match="000003"):
        transformed(open_source(str(folder)), DataOptions()).frame(3)


@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
def test_first_pictures_that_are_no_photographs_are_refused_by_their_headers(tmp_path: Path) -> None:
    """Where no file states a size, the first picture does: 75 MB of pixels are fine, in a file of a hundredth."""
    for name in ("cam_0", "cam_1"):
        (tmp_path / name).mkdir()
        header(5_000, 8, 2)(tmp_path / name / "000000.png")
    with pytest.raises(SourceError, match=r"000000\.png: 66 bytes unpack to 75000000, more than 100 times as many"):
        find_cameras(tmp_path)
    for path in tmp_path.glob("*/*.png"):
        path.write_bytes(path.read_bytes() + bytes(750_000))
    assert [camera.size for camera in find_cameras(tmp_path)[0]] == [(5_000, 5_000)] * 2


@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
@pytest.mark.parametrize(("depth", "size"), [(8, 75_000_000), (16, 150_000_000)])
def test_a_size_that_is_declared_makes_no_photograph_of_a_few_bytes(depth: int, size: int, tmp_path: Path) -> None:
    """Black pixels of a size that cameras.json declares, too, took gigabytes from half a megabyte."""
    path = tmp_path / "000000.png"
    header(5_000, depth, 2)(path)
    with pytest.raises(SourceError, match=rf"000000\.png: 66 bytes unpack to {size}, more than 100 times as many"):
        read_image(path, (5_000, 5_000), (50, 50))
    path.write_bytes(path.read_bytes() + bytes(size // 100))
    with pytest.raises(SourceError, match="cannot be decoded"):
        read_image(path, (5_000, 5_000), (50, 50))


def test_pictures_ask_how_much_memory_they_may_take() -> None:
    """160 x 120 pixels, of which each takes 20 bytes, and 48 where they are averaged down unevenly."""
    for scale, least in ((1.0, 0.384), (0.5, 0.384), (0.3, 0.922)):
        source = open_source("demo", scale)
        with limited_memory(int(least * 1e6) + 1000):
            source.frame(0)
        with (
            limited_memory(int(least * 1e6) - 1000),
            pytest.raises(InputError, match=rf"the picture .*000000.* takes about {least} MB; the limit is .* Raise"),
        ):
            source.frame(0)


def test_videos_ask_how_much_memory_they_may_take(tmp_path: Path) -> None:
    pytest.importorskip("av")
    write_video(tmp_path / "cam_0.mkv", np.zeros((2, 120, 160, 3), np.uint8))
    VideoClip(tmp_path / "cam_0.mkv")
    with limited_memory(900_000), pytest.raises(InputError, match=r"a picture of .*cam_0.mkv takes about 0.922 MB"):
        VideoClip(tmp_path / "cam_0.mkv")


def test_frame_0_needs_every_image(damaged) -> None:
    name = json.loads((damaged / "cameras.json").read_text())["cameras"][0]["frames"] % 0
    (damaged / name).write_bytes(b"no picture")
    with pytest.raises(SourceError, match="000000"):
        transformed(open_source(str(damaged)), DataOptions(bad_image="repeat")).frame(0)


def test_the_end_of_a_recording_is_no_bad_image() -> None:
    class Ended(Wrapped):
        def stored_image(self, index: int, camera: str) -> Any:
            if index > 2:
                raise EndOfRecording("the recording ended after 3 frames")
            return super().stored_image(index, camera)

    source = transformed(Ended(open_source(WORLD)), DataOptions(bad_image="repeat"))
    assert source.frame(2).index == 2
    with pytest.raises(EndOfRecording):
        source.frame(3)
