"""What is said of a rig before an hour is spent: exposures, clocks against pictures, rates."""

from __future__ import annotations

import json
import shutil
import threading
from pathlib import Path

import numpy as np
import pytest
from gsstream_capture.capture import run_capture
from gsstream_capture.check import check
from gsstream_capture.exposure import gains
from gsstream_capture.pictures import CameraPlan
from gsstream_capture.rig import read_rig
from live_rig import encoded, rig_file
from PIL import Image

from gsstream.core.errors import SourceError
from gsstream.encode import open_recording
from gsstream.input.recordings.calibration import read_calibration
from gsstream.input.recordings.open import DEMO_FOLDER


@pytest.fixture(scope="module")
def demo():
    """The demo's cameras: names, plans and pictures [T, C, H, W, 3] uint8 there and back, rgb."""
    with open_recording("demo") as source:
        cameras = source.info.train
        frames = [np.uint8(np.round(255 * source.frame(i).images)) for i in range(source.info.num_frames)]
    filed = read_calibration(DEMO_FOLDER).train
    size = (filed.width, filed.height)
    plans = [CameraPlan(n, filed.Ks[i], filed.viewmats[i], size, "train") for i, n in enumerate(filed.ids)]
    assert cameras.ids == filed.ids
    return plans, np.stack(frames)


def test_gains_are_those_that_were_applied(demo) -> None:
    plans, frames = demo
    applied = np.ones((len(plans), 3))
    applied[1], applied[3] = (0.85, 0.9, 1.0), (1.0, 1.12, 1.0)
    pictures = [np.uint8(np.clip(np.round(p * g), 0, 255)) for p, g in zip(frames[0], applied, strict=True)]
    found = gains(pictures, plans)
    known = ~np.isnan(found[:, 0])
    assert known.sum() >= 4
    plain = gains(list(frames[0]), plans)
    ratio = found[known] / plain[known]
    wanted = applied[known] / np.median(applied[known], axis=0)
    assert np.abs(ratio / np.median(ratio, axis=0) / wanted * np.median(wanted, axis=0) - 1).max() < 0.05


def test_a_camera_that_shares_nothing_has_no_gain(demo) -> None:
    plans, frames = demo
    pictures = [*frames[0][:3], np.full_like(frames[0][3], 90)]
    assert np.isnan(gains(pictures, plans[:4])[3]).all()


def test_two_groups_that_share_nothing_are_not_compared(demo) -> None:
    """The third camera alone links the first two with the others: without it nothing is known of the first two."""
    plans, frames = demo
    pictures = [one[..., ::-1].copy() for one in frames[0]]
    pictures[2][:] = 90
    assert not np.isnan(gains(pictures[:2], plans[:2])).any()
    found = gains(pictures, plans)
    assert np.isnan(found[:3]).all()
    assert (~np.isnan(found[:, 0])).sum() >= 4


def test_a_rig_that_asks_for_it_is_matched(demo, tmp_path) -> None:
    """Each camera's colours are divided by its gain, which cameras.json tells; who shares too little is told."""
    plans, frames = demo
    applied = np.ones((len(plans), 3))
    applied[1], applied[3] = (0.8, 0.85, 0.95), (1.0, 1.15, 1.05)
    changed = np.uint8(np.clip(np.round(frames * applied[None, :, None, None]), 0, 255))
    changed[:, 6] = 90
    rig = films(tmp_path, (plans, changed), 0)
    rig.write_text("exposure: match\n" + rig.read_text())
    said: list[str] = []
    out, whenever = tmp_path / "out", threading.Event()
    run_capture(read_rig(rig), tmp_path, out, seconds=0.5, say=said.append, stopped=whenever)
    assert f"exposure of {plans[6].name} is not matched: too few points that others see, too" in said
    filed = {camera["id"]: camera for camera in json.loads((out / "cameras.json").read_text())["cameras"]}
    assert "gain" not in filed[plans[6].name]
    told = [c for c, plan in enumerate(plans) if "gain" in filed[plan.name]]
    assert {1, 3} <= set(told)
    undone = {c: applied[c] / filed[plans[c].name]["gain"] for c in told}
    # What shines looks brighter from some places, so gains are found between cameras that agree, too.
    pictures = [np.full_like(one, 90) if c == 6 else one[..., ::-1].copy() for c, one in enumerate(frames[0])]
    plain = gains(pictures, plans)[:, ::-1]
    apart = np.array([plain[c] * undone[c] for c in told if not np.isnan(plain[c]).any()])
    assert len(apart) >= 4
    assert not np.isnan(plain[[1, 3]]).any()
    assert np.abs(apart / np.median(apart, axis=0) - 1).max() < 0.05
    assert read_calibration(out, growing=True).train.ids == tuple(plan.name for plan in plans)
    for c in (1, 3):
        with Image.open(out / plans[c].name / "000000.jpg") as image:
            seen = np.asarray(image.convert("RGB")).astype(float)
        # The films go on between: what stands still is what most of a picture shows.
        wanted = np.median(frames[:, c].astype(float), axis=0) * undone[c]
        assert np.median(np.abs(seen - wanted)) < 6


def films(folder: Path, demo, late: int) -> Path:
    """Films of the demo's cameras, of which the third is so many frames late."""
    plans, frames = demo
    shutil.copy(DEMO_FOLDER / "cameras.json", folder / "cameras.json")
    order = [*range(len(frames)), *range(len(frames) - 2, 0, -1)] * 4
    for c, plan in enumerate(plans):
        shift = late if c == 2 else 0
        shown = (frames[order[max(0, i - shift)], c] for i in range(60))
        encoded(folder / plan.name, shown, 10, suffix="mp4")
    return rig_file(folder, {plan.name: f"{plan.name}.mp4" for plan in plans}, 10)


def test_what_agrees_is_said_to_agree(demo, tmp_path) -> None:
    rig, said = films(tmp_path, demo, 0), []
    check(read_rig(rig), tmp_path, tmp_path / "out", seconds=1.2, say=said.append)
    told = said[-1]
    names = [plan.name for plan in demo[0]]
    assert all(f"{name}: 160 x 120, 10.0/s, paired by its own clock, " in told for name in names)
    assert "late" not in told
    assert "early" not in told
    assert sorted(path.stem for path in (tmp_path / "out").glob("*.jpg")) == sorted(names)
    with Image.open(tmp_path / "out" / f"{names[0]}.jpg") as image:
        assert image.size == (160, 120)


def test_pictures_that_contradict_the_clocks_are_refused(demo, tmp_path) -> None:
    rig, said = films(tmp_path, demo, 3), []
    name = demo[0][2].name
    with pytest.raises(SourceError, match=rf"contradict the clocks: camera '{name}' is 3 frames late"):
        check(read_rig(rig), tmp_path, tmp_path / "out", seconds=2.5, say=said.append)
    assert f"{name}: 160 x 120" in said[-1], "the table is said all the same"
