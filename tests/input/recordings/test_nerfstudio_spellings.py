"""transforms.json as other programs spell it: keys, names, lists and numbers are read as they mean, or refused."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from tiny_recordings import SIZE, World, make_world, write_nerfstudio

from gsstream.core.errors import SourceError
from gsstream.input.recordings.open import open_source
from gsstream.input.recordings.sync import RecordingWarning

K = (0.05, -0.01, 0.002, 0.001)


@pytest.fixture(scope="module")
def world() -> World:
    return make_world(frames=1)


def still(
    folder: Path, world: World, change: Callable[[dict[str, Any]], Any] = lambda _: None, suffix: str = "png"
) -> Any:
    """A picture per camera in one folder, images/cam0.png and so on, and what a change makes of the file."""
    write_nerfstudio(folder, world)
    path = folder / "transforms.json"
    data = json.loads(path.read_text())
    del data["test_filenames"], data["ply_file_path"]
    for entry in data["frames"]:
        picture = folder / entry["file_path"] / "0000.png"
        entry["file_path"] += f".{suffix}"
        Image.open(picture).save(folder / entry["file_path"])
        picture.unlink()
        picture.parent.rmdir()
    change(data)
    path.write_text(json.dumps(data))
    return str(folder)


def top(**values: Any) -> Callable[[dict[str, Any]], Any]:
    return lambda data: data.update(values)


def each(change: Callable[[dict[str, Any]], Any]) -> Callable[[dict[str, Any]], Any]:
    return lambda data: [change(entry) for entry in data["frames"]]


COEFFICIENTS = dict(zip(("k1", "k2", "k3", "k4"), K, strict=True))
LENSES = {
    "is_fisheye": (top(is_fisheye=True, **COEFFICIENTS), top(camera_model="OPENCV_FISHEYE", **COEFFICIENTS)),
    "in entries": (each(lambda e: e.update(camera_model="OPENCV_FISHEYE", **COEFFICIENTS)),
                   top(camera_model="OPENCV_FISHEYE", **COEFFICIENTS)),
    "one coefficient": (top(camera_model="SIMPLE_RADIAL", k1=0.02), top(k1=0.02)),
    "two": (top(camera_model="RADIAL", k1=0.02, k2=0.01, k3=0), top(k1=0.02, k2=0.01)),
    "false": (top(is_fisheye=False, k1=0.02, k4=0.0), top(k1=0.02)),
    "null": (top(camera_model=None, is_fisheye=None, k1=0.02), top(k1=0.02)),
    "rational": (top(camera_model="FULL_OPENCV", k1=0.02, k4=0, k5=0, k6=0, p1=0.001), top(k1=0.02, p1=0.001)),
    "radial fisheye": (top(camera_model="RADIAL_FISHEYE", k1=0.05, k2=0.01),
                       top(camera_model="OPENCV_FISHEYE", k1=0.05, k2=0.01, k3=0, k4=0)),
}  # fmt: skip


@pytest.mark.parametrize("name", LENSES)
def test_a_lens_is_read_however_it_is_said(tmp_path: Path, world: World, name: str) -> None:
    said, plain = LENSES[name]
    ours, theirs = open_source(still(tmp_path / "a", world, said)), open_source(still(tmp_path / "b", world, plain))
    straight = open_source(still(tmp_path / "c", world))
    assert np.array_equal(ours.info.train.Ks, theirs.info.train.Ks)
    assert np.array_equal(ours.frame(0).images, theirs.frame(0).images)
    assert not np.array_equal(ours.frame(0).images, straight.frame(0).images)


REFUSED = {
    "entry model": (lambda d: d["frames"][1].update(camera_model="FISHEYE624"), "'FISHEYE624' of camera 'cam1'"),
    "pinhole k1": (top(camera_model="PINHOLE", k1=0.2), "k1 = 0.2 of camera 'cam0' with camera_model PINHOLE"),
    "radial k3": (top(camera_model="RADIAL", k3=0.2), "k3 = 0.2 of camera .* which has k1, k2"),
    "k4": (top(k4=0.1), "is it an OPENCV_FISHEYE"),
    "contradiction": (top(camera_model="OPENCV", is_fisheye=True), "contradicts is_fisheye True"),
    "flag": (top(is_fisheye="yes"), "is_fisheye must be true or false"),
    "shutter": (top(rolling_shutter=[0, 0, 0.1, 0]), "'rolling_shutter' is not supported"),
    "ftheta": (each(lambda e: e.update(ftheta_p0=1.0)), "'ftheta_p0' is not supported"),
    "case": (top(isFisheye=True), "did you mean 'is_fisheye'"),
    "hyphen": (top(**{"camera-angle-x": 1.0}), "did you mean 'camera_angle_x'"),
    "no entry": (top(test_filenames=["images/cam9.png"]), r"test_filenames: 'images/cam9.png' is no file_path"),
    "no list": (top(test_filenames="images/cam3.png"), "test_filenames must be a list of file names"),
    "number list": (top(val_filenames=5), "val_filenames must be a list of file names"),
    "both lists": (top(test_filenames=["images/cam1.png"], train_filenames=["images/cam1.png"]), "'cam1' is in train"),
    "angle": (each(lambda e: (e.pop("fl_x"), e.pop("fl_y"), e.update(camera_angle_x=4.0))), "an angle between 0 and"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_a_key_that_says_how_to_read_and_is_not_understood_is_refused(tmp_path: Path, world: World, name: str) -> None:
    change, said = REFUSED[name]
    with pytest.raises(SourceError, match=said):
        open_source(still(tmp_path / "n", world, change))


def test_keys_that_nobody_knows_are_named_once_and_harmless_ones_are_not(
    tmp_path: Path, world: World, recwarn: Any
) -> None:
    open_source(still(tmp_path / "a", world, top(applied_transform=[[1, 0, 0, 0]] * 3, aabb_scale=16, latlong=False)))
    assert not [w for w in recwarn if w.category is RecordingWarning]
    with pytest.warns(
        RecordingWarning, match=r"not known have no effect: 'sharpnes'; did you mean 'sharpness'"
    ) as told:
        open_source(still(tmp_path / "b", world, each(lambda e: e.update(sharpnes=3.0))))
    assert len([w for w in told if w.category is RecordingWarning]) == 1


@pytest.mark.parametrize(
    ("keys", "fy"),
    [
        ({"camera_angle_x": 2 * math.atan(24 / 50), "camera_angle_y": 2 * math.atan(16 / 40)}, 40),
        ({"x_fov": math.degrees(2 * math.atan(24 / 50)), "y_fov": math.degrees(2 * math.atan(16 / 40))}, 40),
        ({"camera_angle_x": 2 * math.atan(24 / 50)}, 50),
        ({"fl_x": 50.0, "camera_angle_y": 2 * math.atan(16 / 40)}, 40),
    ],
)
def test_each_axis_has_its_own_angle(tmp_path: Path, world: World, keys: dict[str, float], fy: float) -> None:
    def change(data: dict[str, Any]) -> None:
        for entry in data["frames"]:
            del entry["fl_x"], entry["fl_y"]
        data.update(keys)

    K = open_source(still(tmp_path / "n", world, change)).info.train.Ks[0]
    assert np.allclose((K[0, 0], K[1, 1]), (50, fy))


SPELLINGS = {
    "dot in the list": (lambda e: e, "./images/cam3.png"),
    "dot in the entry": (lambda e: e.update(file_path="./" + e["file_path"]), "images/cam3.png"),
    "backslashes": (lambda e: e.update(file_path=e["file_path"].replace("/", "\\")), "images\\cam3.png"),
    "case": (lambda e: e.update(file_path="images/" + e["file_path"][7:].swapcase()), "images/CAM3.png"),
    "no suffix": (lambda e: e.update(file_path=e["file_path"].rpartition(".")[0]), "images/cam3"),
    "suffix in the list": (lambda e: e.update(file_path=e["file_path"].rpartition(".")[0]), "images/cam3.png"),
}


@pytest.mark.parametrize("suffix", ["png", "jpg", "JPEG"])
@pytest.mark.parametrize("name", SPELLINGS)
def test_names_are_found_as_people_write_them(tmp_path: Path, world: World, name: str, suffix: str) -> None:
    change, listed = SPELLINGS[name]

    def spelled(data: dict[str, Any]) -> None:
        each(lambda e: change(e))(data)
        data["test_filenames"] = [listed.replace("png", suffix)]

    source = open_source(still(tmp_path / "n", world, spelled, suffix))
    assert [camera.lower() for camera in source.info.test.ids] == ["cam3"]
    assert [camera.lower() for camera in source.info.train.ids] == ["cam0", "cam1", "cam2"]
    assert source.frame(0).images.shape[0] == 3


def test_cameras_of_no_list_are_left_out_by_name(tmp_path: Path, world: World) -> None:
    lists = top(test_filenames=["images/cam0.png"], train_filenames=["images/cam1.png", "images/cam3.png"])
    with pytest.warns(RecordingWarning, match="no list of file names holds are left out: cam2; 3 of 4 stay"):
        info = open_source(still(tmp_path / "n", world, lists)).info
    assert (info.test.ids, info.train.ids) == (("cam0",), ("cam1", "cam3"))


def test_an_entry_without_a_pose_is_skipped_or_refused_when_asked(tmp_path: Path, world: World) -> None:
    uri = still(tmp_path / "n", world, lambda d: d["frames"][2].update(transform_matrix=None))
    with pytest.warns(
        RecordingWarning, match=r"1 of 4 entries have no transform_matrix, the first is images/cam2.*3 stay"
    ):
        assert open_source(uri).info.train.ids == ("cam0", "cam1", "cam3")
    with pytest.raises(SourceError, match="1 of 4 entries have no transform_matrix"):
        open_source(f"nerfstudio:{uri}?missing=refuse")


def test_pictures_of_an_even_share_of_the_size_are_fitted_and_others_refused(tmp_path: Path, world: World) -> None:
    plain = open_source(still(tmp_path / "a", world)).info.train

    def doubled(data: dict[str, Any]) -> None:
        data.update(w=2 * SIZE[0], h=2 * SIZE[1])
        each(lambda e: e.update({key: 2 * e[key] for key in ("fl_x", "fl_y", "cx", "cy")}))(data)

    with pytest.warns(RecordingWarning, match="4 of 4 cameras are calibrated for another size"):
        fitted = open_source(still(tmp_path / "b", world, doubled)).info.train
    assert np.allclose(fitted.Ks, plain.Ks)
    with pytest.raises(SourceError, match="another part of the view"):
        open_source(still(tmp_path / "c", world, top(w=SIZE[0] + 1)))


def test_null_stands_for_what_is_not_given(tmp_path: Path, world: World) -> None:
    plain = open_source(still(tmp_path / "a", world, lambda d: [d.pop(key) for key in ("fps", "w", "h")]))
    none = open_source(still(tmp_path / "b", world, top(fps=None, w=None, h=None, test_filenames=None)))
    assert none.info.fps == plain.info.fps == 30
    assert np.array_equal(none.info.train.Ks, plain.info.train.Ks)


def test_a_matrix_without_its_last_row_is_a_pose(tmp_path: Path, world: World) -> None:
    plain = open_source(still(tmp_path / "a", world)).info.train
    short = still(tmp_path / "b", world, each(lambda e: e["transform_matrix"].pop()))
    assert np.array_equal(open_source(short).info.train.viewmats, plain.viewmats)
