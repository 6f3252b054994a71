"""From what cameras send to what is written: turned, straight, of one size, in the right colours."""

from __future__ import annotations

import io
import json

import av
import numpy as np
import pytest
from gsstream_capture.folder import FolderWriter
from gsstream_capture.pictures import PINHOLE, jpeg, pixels_of, planned
from live_rig import calibration
from PIL import Image

from gsstream.core.errors import OutputError, SourceError
from gsstream.input.recordings.calibration import read_calibration
from gsstream.input.recordings.lens import undistortion

BENT = {"distortion": [-0.3, 0.1, 0.001, -0.002, 0.01]}


def smooth(size, seed=0):
    """A photograph-like picture [H, W, 3] uint8: slow waves of colour."""
    draw = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(0, 6, size[0]), np.linspace(0, 6, size[1]))
    waves = [np.sin(a * x + b * y + c) for a, b, c in draw.uniform(0, 2, (3, 3))]
    return np.uint8(np.round(128 + 100 * np.stack(waves, -1)))


def decoded(jpeg_bytes):
    return np.asarray(Image.open(io.BytesIO(jpeg_bytes)).convert("RGB"))


@pytest.mark.parametrize("rotate", [0, 90, 180, 270])
def test_pictures_are_turned_clockwise_and_keep_their_colours(rotate) -> None:
    picture = smooth((96, 64))
    frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
    out = decoded(jpeg(pixels_of(frame, rotate), 95))
    turned = np.asarray(Image.fromarray(picture).rotate(-rotate, expand=True))
    assert out.shape == turned.shape
    assert np.abs(out.astype(int) - turned).max() <= 8
    assert np.abs(out.astype(int) - turned).mean() < 1.5


def test_colours_keep_their_full_resolution() -> None:
    """Columns of red and blue in turn: with colours of half the resolution they would become one purple."""
    picture = np.zeros((32, 32, 3), np.uint8)
    picture[:, ::2, 0], picture[:, 1::2, 2] = 250, 250
    out = decoded(jpeg(picture[..., ::-1].copy(), 95)).astype(int)
    assert out[:, ::2, 0].min() > 200
    assert out[:, ::2, 2].max() < 60


def test_a_bent_lens_is_straightened_as_the_library_does(tmp_path) -> None:
    calibration(tmp_path, ["a", "b"], (160, 120), **BENT)
    found = read_calibration(tmp_path, growing=True, any_sizes=True)
    plan, _ = planned(["a", "b"], [0, 0], found, [(160, 120)] * 2, "here")
    picture = smooth((160, 120))
    exact = undistortion(found.lenses["a"], found.train.Ks[0], (160, 120), (160, 120), "here")
    expected = exact.apply(picture.astype(np.float32) / 255)
    assert np.abs(plan.apply(picture) / 255 - expected).max() < 1.2 / 255
    assert np.array_equal(plan.K, exact.K)
    assert not np.array_equal(plan.K, found.train.Ks[0])


def test_cameras_of_two_sizes_are_written_in_one(tmp_path) -> None:
    """Intrinsics follow: what lay on the axis of the camera lies at its principal point."""
    calibration(tmp_path, ["a", "b"], (160, 120))
    found = read_calibration(tmp_path, growing=True, any_sizes=True)
    plans = planned(["a", "b"], [0, 0], found, [(320, 240), (160, 120)], "here")
    assert {plan.size for plan in plans} == {(160, 120)}
    assert plans[0].apply(smooth((320, 240))).shape == (120, 160, 3)
    assert np.allclose(plans[0].K, plans[1].K)


def test_another_part_of_the_view_is_refused(tmp_path) -> None:
    calibration(tmp_path, ["a"], (160, 120))
    found = read_calibration(tmp_path, growing=True, any_sizes=True)
    with pytest.raises(SourceError, match=r"camera 'a' sends pictures of 160 x 90, here is for 160 x 120"):
        planned(["a"], [0], found, [(160, 90)], "here")
    with pytest.raises(SourceError, match=r"sends pictures of 120 x 160.*'rotate'"):
        planned(["a"], [90], found, [(160, 120)], "here")
    assert planned(["a"], [90], found, [(120, 160)], "here")[0].size == (160, 120)
    assert PINHOLE.is_identity


def test_the_folder_is_one_that_a_run_follows(tmp_path) -> None:
    calibration(tmp_path, ["a", "b"], (160, 120))
    found = read_calibration(tmp_path, growing=True, any_sizes=True)
    plans = planned(["a", "b"], [0, 0], found, [(160, 120)] * 2, "here")
    writer = FolderWriter(tmp_path / "out", plans, 12.5, more={"name": "shelf"})
    again = read_calibration(tmp_path / "out", growing=True)
    assert (again.name, again.fps, again.num_frames, again.train.ids) == ("shelf", 12.5, 0, ("a", "b"))
    assert np.array_equal(again.train.viewmats, found.train.viewmats)
    writer.add({0: jpeg(smooth((160, 120)), 90)}, {"absent": ["b"]})
    writer.end()
    names = sorted(path.relative_to(tmp_path / "out").as_posix() for path in (tmp_path / "out").rglob("*.*"))
    assert names == ["a/000000.jpg", "cameras.json", "capture.jsonl"]
    assert (tmp_path / "out" / "END").exists()
    assert json.loads((tmp_path / "out" / "capture.jsonl").read_text()) == {"frame": 0, "absent": ["b"]}
    with pytest.raises(OutputError, match="is not empty"):
        FolderWriter(tmp_path / "out", plans, 12.5, more={})
