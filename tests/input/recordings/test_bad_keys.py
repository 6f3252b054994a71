"""Every key that any reader says it reads, and values that are no number that fits: found by the readers' own lists.

What is given is refused in one sentence that names the file, or has no effect, or leaves a camera out by name.
"""

from __future__ import annotations

import importlib
import json
import pkgutil
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from test_bad_numbers import FILES, known, same

import gsstream.input.recordings as recordings
from gsstream.core.errors import SourceError
from gsstream.input.recordings.base import SourceInfo
from gsstream.input.recordings.foreign import Keys

#: As JSON has them; other formats write the same words.
VALUES = ("null", "0", "-1", "NaN", "Infinity", "1e999", '"text"', "true", "[1.0]")
Set = Callable[[str, str, str], str]


def top(text: str, key: str, value: str) -> str:
    return json.dumps(json.loads(text) | {key: json.loads(value)})


def inner(under: str) -> Set:
    def put(text: str, key: str, value: str) -> str:
        data = json.loads(text)
        data[under][0][key] = json.loads(value)
        return json.dumps(data)

    return put


def last_line(text: str, key: str, value: str) -> str:
    """The last of several counts."""
    return f"{text}{key.replace('*', '00')}: {value}\n"


def toml(text: str, key: str, value: str) -> str:
    word = {"NaN": "nan", "Infinity": "inf", "1e999": "1e308", "null": '"null"'}.get(value, value)
    anchor = "matrix =" if key == "size" else "size ="
    plain = re.sub(rf"\n{key} = [^\n]*", "", text, count=1)
    return plain.replace(anchor, f"{key} = {word}\n{anchor}", 1)


def attribute(anchor: str, prefix: str = "") -> Set:
    """Of the first element that has the anchor among its attributes; elements of that name give way."""

    def put(text: str, key: str, value: str) -> str:
        plain = value.strip('"')
        without = re.sub(rf'\s{prefix}{key}="[^"]*"', " ", text, count=1)
        without = re.sub(rf"<{prefix}{key}>.*?</{prefix}{key}>", "", without, count=1, flags=re.DOTALL)
        return without.replace(anchor, f'{prefix}{key}="{plain}" {anchor}', 1) if key not in anchor else without

    return put


def element(text: str, key: str, value: str) -> str:
    head, separator, rest = text.partition('class="adjusted">')
    rest = re.sub(rf"<{key}>.*?</{key}>", "", rest, count=1)
    return f"{head}{separator}<{key}>{value.strip(chr(34))}</{key}>{rest}"


def column(text: str, key: str, value: str) -> str:
    head, first, *rows = text.splitlines()
    names, cells = head.split(","), first.split(",")
    cells[names.index(key)] = value.strip('"')
    return "\n".join([head, ",".join(cells), *rows]) + "\n"


#: Where the list stands -> (writer of FILES, file, how a key is given a value).
GIVEN: dict[str, tuple[str, str, Set]] = {
    "calibration._KEYS": ("cameras.json", "cameras.json", top),
    "calibration._CAMERA_KEYS": ("cameras.json", "cameras.json", inner("cameras")),
    "layouts.nerfstudio._KEYS": ("nerfstudio", "transforms.json", top),
    "layouts.nerfstudio._KEYS of an entry": ("nerfstudio timed", "transforms.json", inner("frames")),
    "layouts.panoptic._KEYS": ("panoptic", "train_meta.json", top),
    "layouts.easymocap._INTRI": ("easymocap", "intri.yml", last_line),
    "layouts.easymocap._EXTRI": ("easymocap", "extri.yml", last_line),
    "rigs.qualisys._KEYS": ("qualisys", "Calib.qca.txt", attribute("focalLengthU=")),
    "rigs.toml._KEYS": ("anipose", "calibration/rig.toml", toml),
    "rigs.toml._KEYS of Caliscope": ("caliscope", "calibration/rig.toml", toml),
    "rigs.opencv_yaml._KEYS": ("opencv", "cam_0.yml", last_line),
    "rigs.metashape._KEYS": ("metashape", "cameras.xml", element),
    "rigs.realitycapture._METADATA": ("realitycapture-xmp", "cam_0.xmp", attribute("xcr:DistortionModel=", "xcr:")),
    "rigs.realitycapture._COLUMNS": ("realitycapture-csv", "export.csv", column),
}
#: Keys whose value is a text, a choice or a list of names: another one may be another sound recording.
TEXTS = re.compile(
    r"(schema|name|names|licence|id|split|frames|file_path|ply_file_path|camera_model|model|distortion_model|cam_id|port|"
    r"ignore|fisheye|is_fisheye|DistortionModel|#name)$"
)

#: Keys that another one goes before, which is therefore taken out.
BEFORE: dict[str, tuple[str, ...]] = {
    "camera_angle_x": ("fl_x", "fl_y"),
    "camera_angle_y": ("fl_x", "fl_y"),
    "x_fov": ("fl_x", "fl_y"),
    "y_fov": ("fl_x", "fl_y"),
    "D_*": ("dist_00",),
    "R_*": ("Rot_00",),
    "K": ("camera_matrix",),
    "rvec": ("R",),
    "Rot": ("R",),
    "tvec": ("T",),
    "distortion": ("distortion_coefficients",),
    "D": ("distortion_coefficients",),
    "dist": ("distortion_coefficients",),
}
#: Keys that are no numbers of this object: they stand in the other one, or have numbers of their own.
UNREAD: dict[str, list[str]] = {
    "layouts.nerfstudio._KEYS": ["time"],
    "layouts.nerfstudio._KEYS of an entry": ["train_filenames", "val_filenames", "test_filenames", "fps"],
    "rigs.metashape._KEYS": ["resolution"],
}


def without(text: str, key: str) -> str:
    """The file without a key: of JSON the object and all entries, of OpenCV's storage the matrix."""
    if text.startswith("{"):
        data = json.loads(text)
        for entry in (data, *data.get("frames", ())):
            entry.pop(key, None)
        return json.dumps(data)
    return re.sub(rf"(?m)^{re.escape(key)}: !!opencv-matrix$.*?\]\n", "", text, count=1, flags=re.DOTALL)


def lists() -> dict[str, Keys]:
    """Every list of keys of every reader, by where it stands."""
    found = {}
    for info in pkgutil.walk_packages(recordings.__path__, f"{recordings.__name__}."):
        module = importlib.import_module(info.name)
        own = {name: value for name, value in vars(module).items() if isinstance(value, Keys)}
        found |= {f"{info.name.removeprefix(f'{recordings.__name__}.')}.{name}": value for name, value in own.items()}
    return found


def test_every_list_of_keys_is_tried() -> None:
    assert {place.partition(" of ")[0] for place in GIVEN} == set(lists())


def effect(found: SourceInfo | Exception, whole: SourceInfo) -> str:
    """What is wrong with an answer; nothing where it is as it should be."""
    if isinstance(found, Exception):
        return "" if isinstance(found, SourceError) and "\n" not in str(found) else f"a traceback: {found!r}"
    found.train.validate()
    left_out = set(found.train.ids) | set(found.test.ids) < set(whole.train.ids) | set(whole.test.ids)
    return "" if left_out or same(found, whole) else "silently another rig"


@pytest.mark.parametrize("place", GIVEN)
def test_no_key_takes_what_is_no_number(place: str, tmp_path: Path) -> None:
    writer, file, put = GIVEN[place]
    if writer == "cameras.json":
        pytest.importorskip("av")
    folder = FILES[writer][0](tmp_path / "scene")
    path, whole = folder / file, known(folder)
    assert isinstance(whole, SourceInfo), whole
    text = path.read_text()
    numeric = [key for key in lists()[place.partition(" of ")[0]].read.split() if not TEXTS.match(key)]
    bad: list[Any] = []
    refused = dict.fromkeys(numeric, 0)
    for key in numeric:
        plain = text
        for other in (*BEFORE.get(key, ()), *((key,) if put is top and "frames" in json.loads(text) else ())):
            plain = without(plain, other)
        for value in VALUES:
            path.write_text(put(plain, key, value))
            found = known(folder)
            refused[key] += isinstance(found, SourceError)
            told = effect(found, whole)
            # 0 and -1 are numbers, and null may stand for what is not given.
            if told and not (value in ("0", "-1", "null", "[1.0]") and told.startswith("silently")):
                bad.append((key, value, told))
    assert not bad
    unread = [key for key, times in refused.items() if times < 4]
    assert unread == UNREAD.get(place, []), f"takes whatever it is given: {refused}"
