"""Only the documented picture formats are decoded: a file's name says PNG, its bytes decide what would run."""

from __future__ import annotations

import re
import shutil
import stat
import warnings
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsstream.core.errors import SourceError
from gsstream.input.prepare.raw import find_cameras
from gsstream.input.recordings.clips import ImageClip
from gsstream.input.recordings.images import read_image

EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 6\n%%EndComments\nshowpage\n"


def write(path: Path, kind: str) -> None:
    if kind == "EPS":
        path.write_bytes(EPS)
    else:
        Image.fromarray(np.zeros((6, 8, 3), np.uint8)).save(path, format=kind)


@pytest.fixture
def ghostscript(tmp_path, monkeypatch) -> Path:
    """A program called gs that leaves a trace when it is started."""
    folder, trace = tmp_path / "bin", tmp_path / "started"
    folder.mkdir()
    program = folder / "gs"
    program.write_text(f"#!/bin/sh\ntouch {trace}\nexit 1\n")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", str(folder), prepend=":")
    return trace


@pytest.mark.parametrize("kind", ["EPS", "GIF", "BMP", "WEBP", "PPM", "TIFF"])
def test_other_formats_are_refused_everywhere(kind, tmp_path, ghostscript) -> None:
    path = tmp_path / "raw" / "cam0" / "000000.png"
    for camera in ("cam0", "cam1"):
        (tmp_path / "raw" / camera).mkdir(parents=True)
        write(tmp_path / "raw" / camera / "000000.png", kind)
    for read in (
        lambda: read_image(path, (8, 6), (8, 6)),
        lambda: ImageClip([path]),
        lambda: find_cameras(tmp_path / "raw"),
    ):
        with pytest.raises(SourceError, match="JPEG"):
            read()
    assert not ghostscript.exists()


def test_what_phones_write_is_named(tmp_path) -> None:
    """A stub with the header of a HEIC, under its own name and under that of a JPEG."""
    for camera in ("a", "b"):
        (tmp_path / "raw" / camera).mkdir(parents=True)
        (tmp_path / "raw" / camera / "1.HEIC").write_bytes(b"\0\0\0\x18ftypheic" + bytes(20))
    shutil.copy(tmp_path / "raw" / "a" / "1.HEIC", tmp_path / "1.jpg")
    for read in (
        lambda: read_image(tmp_path / "1.jpg", (8, 6), (8, 6)),
        lambda: ImageClip([tmp_path / "1.jpg"]),
        lambda: find_cameras(tmp_path / "raw"),
    ):
        with pytest.raises(SourceError, match="it is HEIC, as phones write it: convert it to JPEG or PNG"):
            read()


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_documented_formats_are_read(kind, tmp_path) -> None:
    write(tmp_path / "a.png", kind)
    assert read_image(tmp_path / "a.png", (8, 6), (8, 6)).shape == (6, 8, 3)
    assert ImageClip([tmp_path / "a.png"]).size == (8, 6)


def test_no_picture_is_opened_without_naming_its_formats() -> None:
    """Every place that opens a picture of a recording names them; a new place must, too."""
    package = Path(__file__).parents[3]
    places = [*package.glob("gsstream/**/*.py"), *package.glob("plugins/*/src/**/*.py")]
    lines = [(path, line) for path in places for line in path.read_text().splitlines()]
    opened = [(path, line) for path, line in lines if re.search(r"Image\.open\(", line)]
    assert len(opened) >= 3
    assert [str(path) for path, line in opened if "formats=PICTURE_FORMATS" not in line] == []


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_a_picture_that_viewers_turn_is_read_as_stored_and_that_is_said(kind, tmp_path) -> None:
    pixels = np.zeros((6, 8, 3), np.uint8)
    pixels[:, 4:] = 255
    tags = Image.Exif()
    for orientation in (1, 6):
        tags[0x0112] = orientation
        Image.fromarray(pixels).save(tmp_path / f"{orientation}.x", format=kind, exif=tags, quality=100, subsampling=0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        upright = read_image(tmp_path / "1.x", (8, 6), (8, 6))
    with pytest.warns(UserWarning, match="EXIF orientation 6"):
        turned = read_image(tmp_path / "6.x", (8, 6), (8, 6))
    assert (turned == upright).all()
