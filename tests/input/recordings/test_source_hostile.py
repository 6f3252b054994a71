"""Files that are well-formed and absurd, and formats that nobody promised: one message, and nothing runs."""

from __future__ import annotations

import io
import json
import re
import shutil
import stat
import time
import tracemalloc
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gsstream.core.errors import InputError, SourceError
from gsstream.core.memory import limited_memory
from gsstream.input.prepare.raw import find_cameras
from gsstream.input.recordings.calibration import read_calibration, read_json
from gsstream.input.recordings.clips import ImageClip
from gsstream.input.recordings.images import read_image
from gsstream.input.recordings.open import DEMO_FOLDER, open_source
from gsstream.input.recordings.pointfiles import read_points
from tests.input.hostile_inputs import measured


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    shutil.copytree(DEMO_FOLDER, tmp_path / "r")
    return tmp_path / "r"


def camera(**values: Any) -> Any:
    return lambda data: data["cameras"][0].update(values)


HUGE = int("9" * 401)
ABSURD = {
    "w2c of 401 digits": camera(w2c=[[HUGE, 0, 0, 0]] * 4),
    "width of 401 digits": camera(width=HUGE),
    "fps of 401 digits": lambda d: d.update(fps=HUGE),
    "frames of a thousand millions": lambda d: d.update(frames=1_000_000_000),
    "frames of nine millions": lambda d: d.update(frames=9_000_000),
    "test cameras of lists": lambda d: d.update(test_cameras=[[]]),
    "test cameras of objects": lambda d: d.update(test_cameras=[{}]),
    "pattern of 5,000 letters": camera(frames="x" * 5000 + "%06d.png"),
    "pattern of 900 letters": camera(frames="x" * 900 + "%06d.png"),
    "padding of 19 seconds": camera(frames="a/%0999999999d.png"),
    "name with half a character": lambda d: d.update(name="a\ud800"),
    "licence of 20 MB": lambda d: d.update(licence="x" * 20_000_000),
}


@pytest.mark.parametrize("what", ABSURD)
def test_absurd_calibrations_are_refused_at_once(what: str, folder: Path) -> None:
    data = json.loads((folder / "cameras.json").read_text())
    ABSURD[what](data)
    (folder / "cameras.json").write_text(json.dumps(data))
    began = time.monotonic()
    with pytest.raises(SourceError, match=r"cameras\.json|missing|camera 'cam") as caught:
        open_source(str(folder))
    assert len(str(caught.value)) < 1000
    assert time.monotonic() - began < 20, "no hang; a second is usual"


@pytest.mark.parametrize("text", ["[" * 100_000, '{"schema": ' + "9" * 5000 + "}"])
def test_json_that_python_refuses_to_read(text: str, folder: Path) -> None:
    (folder / "cameras.json").write_text(text)
    with pytest.raises(SourceError, match="not valid JSON"):
        open_source(str(folder))


def npz(**arrays: Any) -> bytes:
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    return out.getvalue()


RGB = np.zeros((4, 3), np.uint8)


def single() -> bytes:
    out = io.BytesIO()
    np.save(out, RGB)
    return out.getvalue()


def damaged_deflate() -> bytes:
    data = bytearray(npz(xyz=np.random.default_rng(0).normal(size=(500, 3)), rgb=np.zeros((500, 3), np.uint8)))
    with zipfile.ZipFile(io.BytesIO(bytes(data))) as archive:
        at = archive.infolist()[0].header_offset + 60
    data[at : at + 40] = b"\xff" * 40
    return bytes(data)


POINTS = {
    "a single array": single(),
    "texts": npz(xyz=np.array([["a", "b", "c"]] * 4), rgb=RGB),
    "records": npz(xyz=np.zeros((4, 3), "V8"), rgb=RGB),
    "complex": npz(xyz=np.zeros((4, 3), complex), rgb=RGB),
    "beyond float32": npz(xyz=np.full((4, 3), 1e300), rgb=RGB),
    "damaged deflate": damaged_deflate(),
}


@pytest.mark.parametrize("what", POINTS)
def test_absurd_points_are_refused(what: str, tmp_path: Path) -> None:
    (tmp_path / "p.npz").write_bytes(POINTS[what])
    with pytest.raises(SourceError, match=r"p\.npz"):
        read_points(tmp_path / "p.npz", "recording")


def test_a_shape_that_lies_is_refused(tmp_path: Path) -> None:
    from gsstream.input.recordings.layouts.llff import _load

    header = "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000000, 17), }"
    text = header.encode().ljust(118) + b"\n"
    (tmp_path / "poses_bounds.npy").write_bytes(b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text)
    with pytest.raises(SourceError, match="poses_bounds"):
        _load(tmp_path / "poses_bounds.npy")


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


def test_a_message_stays_short_whatever_an_archive_holds(tmp_path: Path) -> None:
    np.savez(tmp_path / "p.npz", **{f"array_{i}": np.zeros(1) for i in range(500)})
    with pytest.raises(SourceError, match=r"no array 'xyz' for points 'recording'; it holds .*array_0") as told:
        read_points(tmp_path / "p.npz", "recording")
    assert len(str(told.value)) < 300


def test_more_cameras_than_a_rig_has_are_refused_before_they_are_read(tmp_path: Path) -> None:
    data = {"frames": 1, "cameras": [{"id": 5, "w2c": 0}] * 10_001}
    (tmp_path / "cameras.json").write_text(json.dumps(data))
    with pytest.raises(SourceError, match=r"cameras\.json: expected at most 10000 cameras, got 10001"):
        open_source(str(tmp_path))


def test_the_json_of_a_calibration_asks_how_much_memory_it_may_take(folder: Path) -> None:
    size = (folder / "cameras.json").stat().st_size
    with limited_memory(9 * size):
        read_calibration(folder)
    with limited_memory(7 * size), pytest.raises(InputError, match=r"reading .*cameras\.json takes about .* Raise"):
        read_calibration(folder)


#: What costs most, per byte: objects, keys, names of pictures, short numbers, nesting.
HEAVY = ("{}", '{"id": 1}', '"a.png"', "0.1", "[[]]", '{"a": {"b": {}}}')


@pytest.mark.parametrize("item", HEAVY)
def test_the_worst_json_takes_little_memory_or_is_refused_unread(item: str, tmp_path: Path) -> None:
    path = tmp_path / "worst.json"
    for size in (990_000, 20_000_000):
        path.write_text('{"a": [' + f"{item}," * (size // (len(item) + 1)) + "{}]}")
        tracemalloc.start()
        try:
            told = ""
            try:
                read_json(path)
            except SourceError as error:
                told = str(error)
            peak = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        assert peak < (2.2 * size if "no picture and no camera needs" in told else 40e6), told


@pytest.mark.parametrize("indent", [None, 4])
def test_the_json_of_many_pictures_is_read(indent: int | None, tmp_path: Path) -> None:
    """Twenty thousand entries of nerfstudio, and a quarter of an hour of Panoptic's five cameras."""
    entry = {"file_path": "images/cam00/000000", "transform_matrix": np.eye(4).tolist(), "time": 0.5, "fl_x": 900.25}
    meta = {"w2c": [[np.eye(4).tolist()] * 5] * 4_000, "fn": [[f"{c}/000000.jpg" for c in range(5)]] * 4_000}
    for data in ({"frames": [entry] * 20_000}, meta):
        path = tmp_path / "large.json"
        path.write_text(json.dumps(data, indent=indent))
        assert read_json(path) == data


@pytest.fixture(scope="module")
def honest() -> float:
    """Peak of memory of the command on the demo, MB."""
    return measured("the demo, as it is")[1]


@pytest.mark.parametrize("name", ["PNG whose data unpack to 500 MB", "text chunk of 200 MB", "recipe of 5 MB"])
def test_a_hostile_input_takes_no_more_memory_than_an_honest_one(name: str, honest: float) -> None:
    """A command on each; all others of the list are run by hand, since writing them takes minutes."""
    code, memory, _, text = measured(name)
    assert code == 2
    assert "Traceback" not in text
    assert memory < honest + 40
