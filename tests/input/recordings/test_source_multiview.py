"""Folders of images: what is read is exact, and every fault is told in words a user can act on."""

from __future__ import annotations

import json
import math
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gsstream.core.errors import SourceError
from gsstream.input.recordings.base import Source
from gsstream.input.recordings.images import shrink
from gsstream.input.recordings.open import DEMO_FOLDER, open_source
from gsstream.input.recordings.pointfiles import read_points
from gsstream.input.recordings.sync import RecordingWarning

Edit = Callable[[dict[str, Any]], None]


def make_recording(folder: Path, *, frames: int = 2, size: tuple[int, int] = (12, 8), suffix: str = "png") -> Path:
    """Three cameras, the last one for testing, with random 8-bit images."""
    rng = np.random.default_rng(3)
    cameras = []
    for i in range(3):
        pose = np.eye(4)
        pose[0, 3] = -0.5 * i
        K = [[10.0, 0, size[0] / 2], [0, 10.0, size[1] / 2], [0, 0, 1]]
        cameras.append(
            {"id": f"cam{i}", "split": "test" if i == 2 else "train", "width": size[0], "height": size[1], "K": K}
            | {"w2c": pose.tolist(), "frames": f"cam{i}/%04d.{suffix}"}
        )
        (folder / f"cam{i}").mkdir(parents=True)
        for t in range(frames):
            pixels = rng.integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
            Image.fromarray(pixels).save(folder / f"cam{i}" / f"{t:04d}.{suffix}")
    data = {"schema": "opencv-multiview-1", "name": "toy", "fps": 10, "frames": frames, "test_cameras": ["cam2"]}
    (folder / "cameras.json").write_text(json.dumps(data | {"licence": "none", "cameras": cameras}))
    return folder


def opened(folder: Path) -> Source:
    return open_source(f"folder:{folder}")


def edit_calibration(folder: Path, edit: Edit) -> None:
    path = folder / "cameras.json"
    data = json.loads(path.read_text())
    edit(data)
    path.write_text(json.dumps(data))


def test_pixels_splits_and_times_are_exact(tmp_path: Path) -> None:
    source = opened(make_recording(tmp_path / "r"))
    assert source.info.train.ids == ("cam0", "cam1")
    assert source.info.test.ids == ("cam2",)
    frame = source.frame(1)
    frame.validate()
    expected = np.asarray(Image.open(tmp_path / "r" / "cam1" / "0001.png")) / 255
    np.testing.assert_allclose(frame.images[1], expected, atol=1e-7)
    assert frame.timestamp == pytest.approx(0.1)
    assert source.frame(1).images.tobytes() == frame.images.tobytes()
    assert source.frame(0, "test").images.shape == (1, 8, 12, 3)
    assert source.points() is None


@pytest.mark.parametrize("target", [(6, 4), (4, 8), (5, 3), (12, 8), (1, 1), (7, 7)])
def test_shrinking_is_the_exact_area_average(target: tuple[int, int]) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (8, 12, 3), dtype=np.uint8)
    # Independent reference: repeat every pixel until the target divides the size, then take block means.
    fine = pixels.astype(np.float64).repeat(target[1], axis=0).repeat(target[0], axis=1)
    expected = fine.reshape(target[1], 8, target[0], 12, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(shrink(pixels, target), expected, rtol=2e-6)


@pytest.mark.parametrize("scale", [0.0, -1.0, 1.5, math.nan])
def test_scale_outside_its_range_is_refused(scale: float) -> None:
    with pytest.raises(SourceError, match=r"scale: expected a factor in \(0, 1\]"):
        open_source("demo", scale)


def test_sixteen_bit_colour_keeps_its_low_byte(tmp_path: Path) -> None:
    from kornia_rs import io

    folder = make_recording(tmp_path / "r")
    pixels = np.random.default_rng(1).integers(0, 65536, (8, 12, 3)).astype(np.uint16)
    io.write_image_png_u16(str(folder / "cam0" / "0000.png"), pixels, "rgb")
    np.testing.assert_allclose(opened(folder).frame(0).images[0], pixels / 65535, atol=1e-7)


def test_grey_images_of_both_depths(tmp_path: Path) -> None:
    folder = make_recording(tmp_path / "r")
    deep = np.random.default_rng(1).integers(0, 65536, (8, 12)).astype(np.uint16)
    Image.fromarray(deep).save(folder / "cam0" / "0000.png")
    Image.fromarray((deep >> 8).astype(np.uint8)).save(folder / "cam1" / "0000.png")
    images = opened(folder).frame(0).images
    np.testing.assert_allclose(images[0], np.repeat(deep[..., None] / 65535, 3, 2), atol=1e-7)
    np.testing.assert_allclose(images[1], np.repeat((deep >> 8)[..., None] / 255, 3, 2), atol=1e-7)


def set_camera(index: int, **values: Any) -> Edit:
    return lambda data: data["cameras"][index].update(values)


def poison_pose(data: dict[str, Any]) -> None:
    data["cameras"][1]["w2c"][0][3] = math.nan


def all_test(data: dict[str, Any]) -> None:
    data["test_cameras"] = ["cam0", "cam1", "cam2"]
    for camera in data["cameras"]:
        camera["split"] = "test"


FAULTS: dict[str, tuple[Edit, str]] = {
    "schema": (
        lambda d: d.update(schema="nerf"),
        r'expected \{"schema": "opencv-multiview-1", "frames": .*got "schema": \'nerf\'; .*scene-formats\.md',
    ),
    "another file": (lambda d: (d.clear(), d.update(frames=[])), r"got the keys \['frames'\]"),
    "no pose": (lambda d: d["cameras"][1].pop("w2c"), r"camera 'cam1' has no 'w2c'; give the 4 x 4 matrix \(world to"),
    "no frames key": (set_camera(1, frames=None), "camera 'cam1' has no frames"),
    "two conversions": (set_camera(1, frames="cam1/%d%d.png"), "one integer conversion"),
    "escape": (set_camera(1, frames="../%04d.png"), "must stay inside"),
    "absolute": (set_camera(1, frames="/etc/%04d.png"), "must stay inside"),
    "empty camera": (set_camera(1, frames="nowhere/%04d.png"), "camera 'cam1' has no frames; expected .*nowhere"),
    "too few frames": (lambda d: d.update(frames=3), r"1 of 3 frames are missing, the first is .*0002\.png"),
    "one image": (set_camera(0, frames="cam0/0000.png"), "names a single image"),
    "frames": (lambda d: d.update(frames=0), "'frames' must be the number of frames"),
    "fps": (lambda d: d.update(fps=-1), "'fps' must be a positive number"),
    "rig sizes": (set_camera(1, width=10), "share one image size, got cam0 12 x 8, cam1 10 x 8"),
    "size type": (set_camera(1, width=12.0), "positive whole pixels"),
    "flat K": (set_camera(1, K=[[0, 0, 6], [0, 10, 4], [0, 0, 1]]), "of camera 'cam1' are not invertible"),
    "K shape": (set_camera(1, K=[[1, 2], [3, 4]]), "K must be 3 x 3 finite numbers"),
    "K text": (set_camera(1, K="wide"), "K must be 3 x 3 finite numbers"),
    "skew": (set_camera(1, K=[[10, 1, 6], [0, 10, 4], [0, 0, 1]]), "expected no skew"),
    "pose": (poison_pose, "'cam1': w2c: every element must be a finite number, got nan"),
    "mirror": (set_camera(1, w2c=np.diag([1.0, 1, -1, 1]).tolist()), "not a rotation"),
    "no training": (all_test, "no training camera"),
    "ghost": (
        lambda d: d.update(test_cameras=["cam9"]),
        "test camera 'cam9' does not exist; cameras: cam0, cam1, cam2",
    ),
    "conflict": (lambda d: d.update(test_cameras=[]), "contradicts 'test_cameras'"),
    "split": (set_camera(0, split="val"), "split must be"),
    "twice": (set_camera(1, id="cam0"), "more than once: cam0"),
    "no cameras": (lambda d: d.update(cameras=[]), "'cameras' must be a non-empty list"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faulty_calibrations_are_explained(tmp_path: Path, fault: str) -> None:
    edit, message = FAULTS[fault]
    folder = make_recording(tmp_path / "r")
    edit_calibration(folder, edit)
    with pytest.raises(SourceError, match=message) as caught:
        opened(folder)
    assert str(folder) in str(caught.value)


def test_missing_folder_calibration_and_json(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no such folder"):
        opened(tmp_path / "absent")
    with pytest.raises(SourceError, match=r"cameras\.json: no such file"):
        opened(tmp_path)
    (tmp_path / "cameras.json").write_text('{"schema": ')
    with pytest.raises(SourceError, match="not valid JSON"):
        opened(tmp_path)


@pytest.mark.parametrize("suffix", ["png", "jpg"])
@pytest.mark.parametrize("kept", [0, 10, 0.5, 0.9])
def test_truncated_images_are_named(tmp_path: Path, suffix: str, kept: float) -> None:
    folder = make_recording(tmp_path / "r", suffix=suffix, size=(64, 48))
    path = folder / "cam1" / f"0001.{suffix}"
    data = path.read_bytes()
    path.write_bytes(data[: int(kept if kept >= 1 else kept * len(data))])
    source = opened(folder)
    source.frame(0).validate()
    with pytest.raises(SourceError, match=rf"cam1.0001\.{suffix}: the image cannot be decoded"):
        source.frame(1)


def test_wrong_size_transparency_and_late_loss_are_named(tmp_path: Path) -> None:
    folder = make_recording(tmp_path / "r")
    source = opened(folder)
    path = folder / "cam0" / "0000.png"
    Image.new("RGB", (6, 4)).save(path)
    with pytest.raises(SourceError, match=r"0000\.png: the image is 6 x 4 .* has 12 x 8"):
        source.frame(0)
    Image.new("RGBA", (12, 8)).save(path)
    with pytest.raises(SourceError, match="transparency"):
        source.frame(0)
    path.unlink()
    with pytest.raises(SourceError, match=r"0000\.png: the image is missing"):
        source.frame(0)


def test_points_that_float32_rounds_far_from_the_origin_are_named(tmp_path: Path) -> None:
    near = np.random.default_rng(0).normal(size=(50, 3))
    far, rgb = near + np.array([400_000.0, 5_000_000.0, 30.0]), np.zeros((50, 3), np.uint8)
    np.savez(tmp_path / "coarse.npz", xyz=far.astype(np.float32), rgb=rgb)
    with pytest.warns(RecordingWarning, match=r"float32, whose steps are 0\.5 .* write float64"):
        read_points(tmp_path / "coarse.npz", "recording")
    for xyz in (far, near.astype(np.float32)):
        np.savez(tmp_path / "fine.npz", xyz=xyz, rgb=rgb)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert np.array_equal(read_points(tmp_path / "fine.npz", "recording").xyz, xyz)


def test_points_variants_and_faults(tmp_path: Path) -> None:
    source = open_source("demo")
    dense, sparse = source.points(), source.points("sparse")
    assert dense is not None
    assert sparse is not None
    assert (len(dense), len(sparse)) == (12000, 6000)
    assert 0 <= dense.rgb.min() < 0.2 < 0.8 < dense.rgb.max() <= 1
    folder = make_recording(tmp_path / "r")
    np.savez(folder / "points_frame0.npz", xyz=np.zeros((2, 3)), rgb=np.zeros((2, 3), np.uint8))
    with pytest.raises(SourceError, match=r"no array 'sparse_xyz' .* it holds xyz, rgb"):
        opened(folder).points("sparse")
    np.savez(folder / "points_frame0.npz", xyz=np.full((2, 3), np.nan), rgb=np.zeros((2, 3), np.uint8))
    with pytest.raises(SourceError, match="2 of 2 points are not finite"):
        opened(folder).points()
    (folder / "points_frame0.npz").write_bytes(b"PK\x03\x04 broken")
    with pytest.raises(SourceError, match="cannot be read"):
        opened(folder).points()


def test_a_static_set_and_a_rig_without_test_cameras(tmp_path: Path) -> None:
    folder = make_recording(tmp_path / "r", frames=1)

    def static(data: dict[str, Any]) -> None:
        del data["test_cameras"]
        for i, camera in enumerate(data["cameras"]):
            camera |= {"split": "train", "frames": f"cam{i}/0000.png"}

    edit_calibration(folder, static)
    source = opened(folder)
    assert len(source.info.test) == 0
    source.frame(0).validate()
    source.frame(0, "test").validate()


def test_the_demo_ships_with_the_package_and_names_its_licence(tmp_path: Path) -> None:
    assert (DEMO_FOLDER.parent / "ATTRIBUTION.md").is_file()
    source = open_source("demo")
    assert source.info.uri == "demo"
    assert "MIT" in source.info.licence
    assert source.info.num_frames == 12
    copy = tmp_path / "copy"
    shutil.copytree(DEMO_FOLDER, copy)
    assert open_source(str(copy)).frame(3).images.tobytes() == source.frame(3).images.tobytes()


@pytest.mark.parametrize("uri", ["", "dem", "rtsp://camera", "/no/such/place"])
def test_unknown_sources_tell_what_exists(uri: str) -> None:
    with pytest.raises(SourceError, match="demo") as caught:
        open_source(uri)
    if uri:
        assert "synthetic:" in str(caught.value)
