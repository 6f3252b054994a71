"""Every reader of keys: one that no list holds is named, and one that says how to read numbers is refused."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from test_bad_numbers import FILES, known, same

from gsstream.core.errors import SourceError
from gsstream.input.recordings.base import SourceInfo
from gsstream.input.recordings.open import open_source
from gsstream.input.recordings.sync import RecordingWarning

Edit = Callable[[str, str, str], str]


def top(text: str, key: str, value: str) -> str:
    return json.dumps(json.loads(text) | {key: json.loads(value)})


def inner(under: str) -> Edit:
    """In the first object of a list."""

    def edit(text: str, key: str, value: str) -> str:
        data = json.loads(text)
        data[under][0][key] = json.loads(value)
        return json.dumps(data)

    return edit


def last_line(text: str, key: str, value: str) -> str:
    return f"{text}{key}: {value}\n"


def before(word: str, form: str) -> Edit:
    """Before the first ``word``, what ``form`` makes of KEY and VALUE."""
    return lambda text, key, value: text.replace(word, form.replace("KEY", key).replace("VALUE", value) + word, 1)


def column(text: str, key: str, value: str) -> str:
    head, *rows = text.splitlines()
    return "\n".join([f"{head},{key}", *(f"{row},{value}" for row in rows)]) + "\n"


#: Name -> (writer of FILES, file, how a key comes in, a key that is refused, a spelling of a key that is read).
READERS: dict[str, tuple[str, str, Edit, str, str]] = {
    "cameras.json": ("cameras.json", "cameras.json", top, "", "Frames"),
    "cameras.json, a camera": ("cameras.json", "cameras.json", inner("cameras"), "k1", "W2C"),
    "nerfstudio": ("nerfstudio", "transforms.json", top, "skew", "FL_X"),
    "nerfstudio, an entry": ("nerfstudio", "transforms.json", inner("frames"), "k7", "transformMatrix"),
    "panoptic": ("panoptic", "train_meta.json", top, "distCoef", "camId"),
    "easymocap": ("easymocap", "intri.yml", last_line, "xi_00", "Names"),
    "easymocap, poses": ("easymocap", "extri.yml", last_line, "RT_00", "Names"),
    "qualisys": ("qualisys", "Calib.qca.txt", before("focalLengthU=", 'KEY="VALUE" '), "skew", "FocalLengthV"),
    "anipose": ("anipose", "calibration/rig.toml", before("size =", "KEY = VALUE\n"), "skew", "Fisheye"),
    "caliscope": ("caliscope", "calibration/rig.toml", before("size =", "KEY = VALUE\n"), "convention", "Fisheye"),
    "opencv": ("opencv", "cam_0.yml", last_line, "xi", "ImageWidth"),
    "metashape": ("metashape", "cameras.xml", before("<f>9", "<KEY>VALUE</KEY>"), "p3", "B2"),
    "realitycapture-xmp": (
        "realitycapture-xmp",
        "cam_0.xmp",
        before("xcr:DistortionModel", 'xcr:KEY="VALUE" '),
        "Skew",
        "aspectRatio",
    ),
    "realitycapture-csv": ("realitycapture-csv", "export.csv", column, "skew", "K4"),
}


@pytest.mark.parametrize("name", READERS)
def test_no_key_is_passed_over(name: str, tmp_path: Path) -> None:
    writer, file, edit, refused, spelled = READERS[name]
    if writer == "cameras.json":
        pytest.importorskip("av")
    folder = FILES[writer][0](tmp_path / "scene")
    path, whole = folder / file, known(folder)
    text = path.read_text()
    assert isinstance(whole, SourceInfo), whole
    path.write_text(edit(text, "zzz", "1"))
    with pytest.warns(RecordingWarning, match=rf"{re.escape(str(path))}.*keys that are not known .*'zzz'"):
        found = open_source(str(folder)).info
    assert same(found, whole)
    for key, told in ((refused, "is not supported, and says how"), (spelled, "did you mean")):
        if not key:
            continue
        path.write_text(edit(text, key, "1"))
        with pytest.raises(SourceError, match=rf"{re.escape(str(path))}.*{key}.*{told}"):
            open_source(str(folder))
    if refused:
        path.write_text(edit(text, refused, "0"))
        assert isinstance(known(folder), SourceInfo), "zero says nothing"


@pytest.mark.parametrize(("old", "new"), [("Position", "Place"), ("Rotation", "Turn")])
def test_a_camera_that_realitycapture_did_not_align_is_left_out(old: str, new: str, tmp_path: Path) -> None:
    folder = FILES["realitycapture-xmp"][0](tmp_path / "scene")
    path = folder / "cam_1.xmp"
    path.write_text(path.read_text().replace(f"xcr:{old}", f"xcr:{new}"))
    with pytest.warns(RecordingWarning, match=r"without a pose .*cam_1; 2 of 3 stay"):
        assert open_source(str(folder)).info.train.ids == ("cam_0", "cam_2")


def test_pixels_that_are_not_square_are_refused(tmp_path: Path) -> None:
    folder = FILES["realitycapture-xmp"][0](tmp_path / "scene")
    path = folder / "cam_0.xmp"
    path.write_text(path.read_text().replace("xcr:DistortionModel", 'xcr:AspectRatio="1.01" xcr:DistortionModel'))
    with pytest.raises(SourceError, match=r"cam_0\.xmp: expected AspectRatio 1, got 1\.01"):
        open_source(str(folder))
