"""A recording whose first frames are black: the run says so, when it begins, when pictures come, and in its summary."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from flow_runs import arguments, demo_copy, metrics
from PIL import Image

from gsstream.cli.main import run_command
from gsstream.core.cameras import Cameras
from gsstream.core.frame import Frame
from gsstream.engine.run.blank import BlankCameras, BlankStart, blank_views


def black(folder: Path, *frames: int) -> None:
    for frame in frames:
        for path in folder.glob(f"*/{frame:06d}.jpg"):
            with Image.open(path) as image:
                size = image.size
            Image.fromarray(np.random.default_rng(frame).integers(0, 3, (*size[::-1], 3), np.uint8)).save(path)


@pytest.mark.parametrize("blank", [(), (0,), (0, 1), (1,)], ids=str)
def test_a_black_beginning_is_said_thrice(
    blank: tuple[int, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = demo_copy(tmp_path / "recording", frames=4)
    black(folder, *blank)
    out = tmp_path / "out"
    command = arguments(out, "--scale", "0.5", source=str(folder), background="auto", first_frame__max_iterations=8)
    assert run_command(command) == 0
    said, summary = capsys.readouterr().err, (out / "summary.txt").read_text()
    begins_blank = 0 in blank
    assert said.count("frame 0 shows nothing in any training camera") == begins_blank
    first = max(blank, default=-1) + 1
    assert said.count(f"frame {first} is the first that shows something, and frame 0") == begins_blank
    assert summary.count("frame 0 shows nothing in any training camera") == begins_blank
    assert [line.get("blank_views") for line in metrics(out)] == [3 * begins_blank, None, None, None]
    assert json.loads((out / "metrics.jsonl").read_text().splitlines()[0])["frame"] == 0


def test_what_shows_nothing() -> None:
    cameras = Cameras(("a", "b"), np.stack([np.eye(4)] * 2), np.stack([np.eye(3)] * 2), 64, 48)
    noise = np.random.default_rng(0).normal(0.5, 0.004, (48, 64, 3)).astype(np.float32)
    ramp = np.broadcast_to(np.linspace(0, 1, 64, dtype=np.float32)[None, :, None], (48, 64, 3))
    both = Frame(0, 0.0, np.stack([noise, ramp]), cameras)
    assert blank_views(both) == 1
    assert blank_views(Frame(0, 0.0, np.rint(both.images * 255).astype(np.uint8), cameras)) == 1
    watcher = BlankStart()
    assert watcher.look(both) == ""
    nothing = Frame(0, 0.0, np.stack([noise, noise]), cameras)
    assert "frame 0 shows nothing" in watcher.look(nothing)
    later = Frame(1, 0.0, nothing.images, cameras)
    assert watcher.look(later) == ""
    assert "frame 2 is the first" in watcher.look(Frame(2, 0.0, both.images, cameras))
    assert watcher.look(Frame(3, 0.0, both.images, cameras)) == ""


def test_a_camera_that_goes_black_is_named_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = demo_copy(tmp_path / "recording", frames=4)
    one = sorted(path.name for path in folder.iterdir() if path.is_dir())[1]
    for frame in (1, 2):
        black_picture = folder / one / f"{frame:06d}.jpg"
        with Image.open(black_picture) as image:
            Image.new("RGB", image.size).save(black_picture)
    assert run_command(arguments(tmp_path / "out", source=str(folder), first_frame__max_iterations=8)) == 0
    said = capsys.readouterr().err
    assert said.count(f"warning: camera {one} shows nothing in frame 1, but one colour") == 1
    assert said.count("shows nothing") == 1


def test_cameras_that_never_showed_anything_are_not_named_again() -> None:
    cameras = Cameras(("a", "b"), np.stack([np.eye(4)] * 2), np.stack([np.eye(3)] * 2), 64, 48)
    ramp = np.broadcast_to(np.linspace(0, 1, 64, dtype=np.float32)[None, :, None], (48, 64, 3))
    shown, half = np.stack([ramp, ramp]), np.stack([np.zeros_like(ramp), ramp])
    watcher = BlankCameras()
    said = [watcher.look(Frame(at, 0.0, images, cameras)) for at, images in enumerate((half, half, shown, 0 * shown))]
    assert said[:3] == ["", "", ""]
    assert said[3].startswith("camera b shows nothing in frame 3")
