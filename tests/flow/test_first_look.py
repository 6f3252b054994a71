"""What a run says about a recording before an hour is spent on it: wrong poses, and what nobody asked for."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from flow_runs import arguments, demo_copy

from gsstream.cli.main import run_command
from gsstream.core.frame import Frame, join_frames
from gsstream.discovery.catalog import load_catalog
from gsstream.encode import open_recording
from gsstream.engine.run.measure import HeldOut
from gsstream.input.prepare.pose_checks import check_poses, check_swapped, first_look
from gsstream.input.recordings.base import Source
from gsstream.input.seeds import sweep

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
#: Poses as others write them, and what undoes it.
WRONG = {
    "c2w": (np.linalg.inv, "invert w2c"),
    "opengl": (lambda pose: FLIP @ pose, "rows 2 and 3 of w2c by -1"),
    "opengl c2w": (lambda pose: np.linalg.inv(pose) @ FLIP, "columns 2 and 3 by -1 and invert"),
}


@pytest.fixture(scope="module")
def frame() -> Frame:
    with open_recording("demo") as source:
        assert first_look(source) == []
        return source.frame(0)


def test_a_black_camera_is_named_before_a_run(frame: Frame) -> None:
    with open_recording("demo") as source:
        images = frame.images.copy()
        images[2] = 0
        black = SimpleNamespace(info=source.info, frame=lambda index, split: replace(frame, images=images))
        (finding,) = first_look(cast("Source", black))
        assert finding.code == "blank"
        assert f"camera {source.info.train.ids[2]!r} is black" in finding.message


@pytest.mark.parametrize("pair", [(0, 8), (1, 2), (7, 3)])
def test_swapped_cameras_are_named_and_one_wrong_pose_is_no_swap(frame: Frame, pair: tuple[int, int]) -> None:
    """The last camera is the test camera."""
    with open_recording("demo") as source:
        whole = join_frames(frame, source.frame(0, "test"))
        a, b = pair
        images = whole.images.copy()
        images[[a, b]] = images[[b, a]]
        shown = {
            split: replace(f, images=images[at])
            for split, f, at in (("train", frame, slice(8)), ("test", source.frame(0, "test"), slice(8, 9)))
        }
        mixed = SimpleNamespace(info=source.info, frame=lambda index, split: shown[split])
        (finding,) = first_look(cast("Source", mixed))
    first, second = (whole.cameras.ids[c] for c in sorted(pair))
    assert f"cameras {first!r} and {second!r} are swapped" in finding.message
    poses = whole.cameras.viewmats.copy()
    poses[a] = FLIP @ poses[a]
    assert check_swapped(replace(whole, cameras=replace(whole.cameras, viewmats=poses))) == []


@pytest.mark.parametrize("name", WRONG)
def test_a_convention_is_told_by_one_frame(frame: Frame, name: str) -> None:
    wrong, cure = WRONG[name]
    poses = np.stack([wrong(pose) for pose in frame.cameras.viewmats])
    found = check_poses(replace(frame, cameras=replace(frame.cameras, viewmats=poses)))
    assert [(finding.code, finding.severity) for finding in found] == [("axes", "error")]
    assert cure in found[0].message


def test_each_of_its_small_operations_is_done_by_one_thread(frame: Frame, monkeypatch: pytest.MonkeyPatch) -> None:
    """Others would only wait for it, and keep their processors busy for many times as long as the work takes."""
    seen, cost, before = [], sweep._matching_cost, torch.get_num_threads()

    def watched(*given: Any, **named: Any) -> Any:
        seen.append(torch.get_num_threads())
        return cost(*given, **named)

    monkeypatch.setattr(sweep, "_matching_cost", watched)
    torch.set_num_threads(2)
    try:
        assert check_poses(frame) == []
        assert (set(seen), torch.get_num_threads()) == ({1}, 2)
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize("seed", range(4))
def test_right_poses_raise_no_alarm_in_any_world(frame: Frame, seed: int) -> None:
    """Turned, moved and scaled, as few cameras as there may be, darker, noisy, without texture."""
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = turn * np.sign(np.linalg.det(turn)), rng.normal(0, 10, 3)
    poses = frame.cameras.viewmats @ np.linalg.inv(world)
    poses[:, :3, 3] *= 10.0 ** rng.uniform(-3, 3)
    kept = np.sort(rng.choice(len(poses), 3 + seed, replace=False))
    images = np.clip(frame.images * rng.uniform(0.1, 1) + rng.normal(0, 0.02, frame.images.shape), 0, 1)
    cameras = replace(frame.cameras, viewmats=poses).select(kept.tolist())
    assert check_poses(Frame(0, 0.0, images[kept].astype(np.float32), cameras)) == []
    assert check_swapped(Frame(0, 0.0, images[kept].astype(np.float32), cameras)) == []
    assert check_poses(Frame(0, 0.0, np.full_like(images[kept], 0.5, dtype=np.float32), cameras)) == []


def inverted(data: dict) -> None:
    for camera in data["cameras"]:
        camera["w2c"] = np.linalg.inv(np.array(camera["w2c"])).tolist()


def test_a_run_warns_of_inverse_poses_and_says_what_it_takes(tmp_path: Path, capsys) -> None:
    folder = demo_copy(tmp_path / "c2w", train=8, frames=2, edit=inverted)
    command = arguments(tmp_path / "o", "--frames", "9", source=str(folder), scale=0.5)
    assert run_command([word for word in command if word not in ("--quiet", "--method", "dense")]) == 0
    said = capsys.readouterr().err
    assert f"invert w2c. All checks: gsstream scene validate {folder}" in said
    assert "note: no --method given: taking 'dense'" in said
    better = "s2gs-fast"
    assert (f"--method {better}" in said) == (("method", better) in load_catalog().entries)
    assert "note: 9 frames are wanted, the recording has 2: encoding 2" in said


def test_a_run_without_test_cameras_says_so_once_and_nothing_when_quiet(tmp_path: Path, capsys) -> None:
    def no_test_camera(data: dict) -> None:
        data["cameras"] = [camera for camera in data["cameras"] if camera["split"] == "train"]
        data["test_cameras"] = []

    folder = demo_copy(tmp_path / "r", frames=1, edit=no_test_camera)
    for quiet, lines in ((True, 0), (False, 1)):
        command = arguments(tmp_path / "o", "--overwrite", source=str(folder), scale=0.25)
        assert run_command([word for word in command if quiet or word != "--quiet"]) == 0
        assert capsys.readouterr().err.count("no camera is held out, so no quality is measured") == lines
    assert json.loads((tmp_path / "o" / "metrics.jsonl").read_text()).get("psnr", {}) == {}


class Shown(HeldOut):
    """Stands for a renderer: the held-out camera is shown black, and training cameras what they saw, or black too."""

    def __init__(self, sound: bool) -> None:
        self.sound = sound

    def render(self, player: object, frame: Frame, view: int) -> np.ndarray:
        return np.clip(frame.images[view] + 0.02, 0, 1) if self.sound else np.zeros_like(frame.images[view])


def test_a_frame_0_far_below_its_training_views_is_doubted(frame: Frame) -> None:
    said = Shown(sound=True).doubt(None, frame, {"cam08": 10.0})
    assert "held-out cameras show 10.0 dB" in said
    assert Shown(sound=True).doubt(None, frame, {"cam08": 24.0}) == ""
    assert Shown(sound=True).doubt(None, frame, {"cam08": None}) == "", "nothing was measured"
    assert Shown(sound=False).doubt(None, frame, {"cam08": 10.0}) == "", "a short run shows nobody anything"


def test_a_test_camera_that_gets_darker_alone_is_named_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with open_recording("demo") as source:
        (test,) = source.info.test.ids
    for around, times in ((f"disturbed:drift={test}@-0.15:", 1), ("disturbed:gain=0.9:", 0)):
        out = tmp_path / str(times)
        assert run_command(arguments(out, "--frames", "4", source=f"{around}demo", first_frame__max_iterations=40)) == 0
        said = capsys.readouterr().err
        assert said.count(f"warning: test camera {test} has become") == times
        assert said.count("has become") == times
