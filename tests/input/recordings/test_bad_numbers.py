"""Every reader, every number of a small valid file, and values that are no such number.

A value is refused in one sentence that names the file, or it had no effect; 0 and -1 may be numbers that fit.
"""

from __future__ import annotations

import json
import re
import shutil
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_rigs import FORMATS, declared, pictures
from tiny_recordings import LAYOUTS, make_world, write_colmap

from gsstream.core.errors import SourceError
from gsstream.input.recordings.base import SourceInfo
from gsstream.input.recordings.open import open_source

VALUES: dict[str, Any] = {
    "null": None, "zero": 0, "negative": -1, "nan": float("nan"), "inf": float("inf"), "huge": 10**400, "text": "text",
    "true": True, "list": [1.0],
}  # fmt: skip
#: Values that are numbers, and may be right.
NUMBERS = ("zero", "negative")
#: A number that stands alone in a text.
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?(?![\w.])")


def rig(write: Callable[[Path], None]) -> Callable[[Path], Path]:
    def made(folder: Path) -> Path:
        pictures(folder)
        write(folder)
        return folder

    return made


def lens(folder: Path) -> Path:
    pictures(folder)
    declared(folder)
    return folder


def layout(name: str) -> Callable[[Path], Path]:
    return lambda folder: LAYOUTS[name].write(folder, make_world(views=3, frames=2))


def bent_model(folder: Path) -> Path:
    extra = (0.01, 0.0, 0.001, 0.0)
    return write_colmap(
        folder, make_world(views=3, frames=1), binary=False, frames="images", model="OPENCV", extra=extra
    )


#: Name -> (writer, the files whose numbers are exchanged).
FILES: dict[str, tuple[Callable[[Path], Path], tuple[str, ...]]] = {
    "cameras.json": (lens, ("cameras.json",)),
    "nerfstudio": (layout("nerfstudio"), ("transforms.json",)),
    "nerfstudio timed": (layout("nerfstudio timed"), ("transforms.json",)),
    "panoptic": (layout("panoptic"), ("train_meta.json",)),
    "easymocap": (layout("enerf"), ("intri.yml", "extri.yml")),
    "colmap": (bent_model, ("sparse/0/cameras.txt", "sparse/0/images.txt", "sparse/0/points3D.txt")),
    "qualisys": (rig(FORMATS["qualisys"][0]), ("Calib.qca.txt",)),
    "anipose": (rig(FORMATS["anipose"][0]), ("calibration/rig.toml",)),
    "caliscope": (rig(FORMATS["caliscope"][0]), ("calibration/rig.toml",)),
    "opencv": (rig(FORMATS["opencv"][0]), ("cam_0.yml",)),
    "metashape": (rig(FORMATS["metashape"][0]), ("cameras.xml",)),
    "realitycapture-xmp": (rig(FORMATS["realitycapture-xmp"][0]), ("cam_0.xmp",)),
    "realitycapture-csv": (rig(FORMATS["realitycapture-csv"][0]), ("export.csv",)),
}  # fmt: skip
#: As many numbers of a file; what follows are other cameras.
MOST = 30


def numbers_of(data: Any, place: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Places of the numbers of a JSON value, of each list those of the first two elements."""
    if isinstance(data, dict):
        for key, value in data.items():
            yield from numbers_of(value, (*place, key))
    elif isinstance(data, list):
        for i, value in enumerate(data[:2]):
            yield from numbers_of(value, (*place, i))
    elif isinstance(data, int | float):
        yield place


def spoiled(text: str, value: Any, as_json: bool) -> Iterator[tuple[str, str]]:
    """What a file becomes, per number: (the number's place, text)."""
    if as_json:
        for place in list(numbers_of(json.loads(text)))[:MOST]:
            data = json.loads(text)
            inside = data
            for key in place[:-1]:
                inside = inside[key]
            inside[place[-1]] = value
            yield "/".join(map(str, place)), json.dumps(data)
        return
    word = "null" if value is None else "true" if value is True else "1.0 1.0" if value == [1.0] else str(value)
    for found in list(NUMBER.finditer(text))[:MOST]:
        yield text[max(0, found.start() - 30) : found.end()], text[: found.start()] + word + text[found.end() :]


def spoiled_rows(rows: np.ndarray, value: Any) -> Iterator[tuple[str, np.ndarray]]:
    """What an array becomes, per number of its first row: as numpy keeps such a value, with a type of its own."""
    for column in range(rows.shape[1]):
        data: np.ndarray = rows.astype(object)
        data[0, column] = value
        try:
            yield str(column), data.astype(type(value) if isinstance(value, str | bool) else float)
        except (TypeError, ValueError, OverflowError):
            yield str(column), data


def known(folder: Path) -> SourceInfo | Exception:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            source = open_source(str(folder))
            source.points()
        except Exception as error:
            return error
    return source.info


def same(a: SourceInfo, b: SourceInfo) -> bool:
    pairs = ((a.train, b.train), (a.test, b.test))
    equal = (x.ids == y.ids and np.array_equal(x.viewmats, y.viewmats) and np.array_equal(x.Ks, y.Ks) for x, y in pairs)
    return a.fps == b.fps and a.num_frames == b.num_frames and all(equal)


@pytest.mark.parametrize("name", FILES)
def test_what_is_no_number_is_refused_or_has_no_effect(tmp_path: Path, name: str) -> None:
    if name == "cameras.json":
        pytest.importorskip("av")
    write, files = FILES[name]
    folder = write(tmp_path / "scene")
    whole = known(folder)
    assert isinstance(whole, SourceInfo)
    tried = 0
    for file in files:
        path = folder / file
        text = path.read_text()
        for kind, value in VALUES.items():
            for place, changed in spoiled(text, value, path.suffix == ".json"):
                path.write_text(changed)
                told = f"{file}: {kind} at {place!r}"
                tried += 1
                found = known(folder)
                if isinstance(found, Exception):
                    assert isinstance(found, SourceError), f"{told}: a traceback: {found!r}"
                    assert str(folder) in str(found), told
                    assert "\n" not in str(found), told
                    continue
                found.train.validate()
                assert 0 < found.fps < np.inf, told
                left_out = set(found.train.ids) | set(found.test.ids) < set(whole.train.ids) | set(whole.test.ids)
                assert kind in NUMBERS or kind == "null" or left_out or same(found, whole), (
                    f"{told}: silently another rig"
                )
        path.write_text(text)
    assert tried > 5 * len(VALUES)
    shutil.rmtree(folder)


@pytest.mark.parametrize("kind", [kind for kind in VALUES if kind != "list"])
def test_what_is_no_number_of_an_array_is_refused_or_has_no_effect(tmp_path: Path, kind: str) -> None:
    """poses_bounds.npy; its last two columns, depths, are not used."""
    folder = layout("n3dv folders")(tmp_path / "scene")
    path, whole = folder / "poses_bounds.npy", known(folder)
    assert isinstance(whole, SourceInfo)
    for place, rows in spoiled_rows(np.load(path), VALUES[kind]):
        np.save(path, rows, allow_pickle=True)
        found = known(folder)
        if isinstance(found, Exception):
            assert isinstance(found, SourceError), f"{kind} in column {place}: a traceback: {found!r}"
            assert str(path) in str(found)
            assert "\n" not in str(found)
            continue
        found.train.validate()
        found.test.validate()
        assert kind in NUMBERS or same(found, whole), f"{kind} in column {place}: silently another rig"
