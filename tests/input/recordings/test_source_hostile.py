"""cameras.json and points that are well-formed and absurd: one message, at once, and nothing allocated for them."""

from __future__ import annotations

import io
import json
import shutil
import time
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsstream.core.errors import SourceError
from gsstream.input.recordings.multiview import read_points
from gsstream.input.recordings.open import DEMO_FOLDER, open_source


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
