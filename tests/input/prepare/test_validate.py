"""Every bad scene gives one clear message; good ones give none."""

from __future__ import annotations

import importlib.util
import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from gsstream.cli.main import run_command
from gsstream.input.prepare.findings import CHECKS
from gsstream.input.prepare.validate import validate
from gsstream.input.recordings.open import open_source
from tests.input.prepare.bad_scenes import BAD, MESSAGES, BadScene, findings, said, spoiled, without_numbers, write_good

needs_pycolmap = pytest.mark.skipif(importlib.util.find_spec("pycolmap") is None, reason="pycolmap is not installed")
RECORDINGS = Path(__file__).parents[4] / "shared" / "data"


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes") / "good"
    write_good(folder)
    return folder


def one_message(good: Path, folder: Path, bad: BadScene) -> None:
    folder = spoiled(good, folder / "scene", bad)
    found = findings(folder)
    assert [finding.code for finding in found] == [bad.code]
    got = [f"{finding.severity}: {said(folder, finding)}" for finding in found]
    expected = json.loads(MESSAGES.read_text())[bad.name]
    assert list(map(without_numbers, got)) == list(map(without_numbers, expected))


@pytest.mark.parametrize("bad", [bad for bad in BAD if bad.code != "epipolar"], ids=lambda bad: bad.name)
def test_a_bad_scene_gives_one_message(good: Path, tmp_path: Path, bad: BadScene) -> None:
    one_message(good, tmp_path, bad)


@pytest.mark.sfm
@needs_pycolmap
@pytest.mark.parametrize("bad", [bad for bad in BAD if bad.code == "epipolar"], ids=lambda bad: bad.name)
def test_a_calibration_that_the_pictures_contradict_gives_one_message(
    good: Path, tmp_path: Path, bad: BadScene
) -> None:
    one_message(good, tmp_path, bad)


def test_every_check_has_a_bad_scene_and_every_message_its_scene() -> None:
    assert {bad.code for bad in BAD} == set(CHECKS)
    assert list(json.loads(MESSAGES.read_text())) == [bad.name for bad in BAD]
    assert len(BAD) >= 20


@pytest.mark.sfm
@needs_pycolmap
def test_the_good_scene_and_the_demo_are_fine(good: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["scene", "validate", str(good)]) == 0
    assert run_command(["scene", "validate", "demo", "--no-features"]) == 0
    assert capsys.readouterr().out == (
        f"{good}: fine ({len(CHECKS)} checks)\ndemo: fine ({len(CHECKS) - 1} checks; not checked: epipolar)\n"
    )


def test_what_is_looked_at_is_said_before_it_takes_time(good: Path) -> None:
    said: list[str] = []
    assert validate(lambda scale: open_source(str(good), scale), frames=4, features=False, say=said.append) == []
    assert all(line.startswith("checking the scene: ") for line in said)
    assert len(set(said)) == len(said) > 3


def test_the_command_fails_on_a_bad_scene(good: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = next(bad for bad in BAD if bad.name == "black")
    folder = spoiled(good, tmp_path / "scene", bad)
    assert run_command(["scene", "validate", str(folder), "--no-features"]) == 2
    out = capsys.readouterr().out
    assert "error: [blank] camera 'cam03' is black (mean 0.00, no structure); take it out" in out
    assert "1 error;" in out


def test_offsets_of_clocks_are_found_in_both_directions_and_never_made_up() -> None:
    """One camera of the toy scene shows other instants than the rest; the moving things are textured and quick."""
    from dataclasses import replace

    from gsstream.input.prepare.picture_checks import read_thumbnails
    from gsstream.input.prepare.sync_checks import check_sync
    from gsstream.input.prepare.validate import rig_of

    source = open_source("synthetic:width=96&height=72&views=5&frames=28&supersample=1&motion=4")
    thumbs = read_thumbnails(source, rig_of(source), 28)

    def told(shift: int, frames: int = 16) -> list[str]:
        images = thumbs.images[6 : 6 + frames].copy()
        images[:, 2] = thumbs.images[6 + shift : 6 + shift + frames, 2]
        return [finding.message.split(":")[0] for finding in check_sync(replace(thumbs, images=images))]

    rows = {
        -3: ["camera 'cam02' is 3 frames late"],
        -1: ["camera 'cam02' is 1 frame late"],
        0: [],
        1: ["camera 'cam02' is 1 frame early"],
        3: ["camera 'cam02' is 3 frames early"],
        4: ["camera 'cam02' is at least 4 frames early"],
    }
    assert {shift: told(shift) for shift in rows} == rows
    assert told(0, frames=3) == ["clocks"], "three frames are too few to compare clocks, which is said"
    still = replace(thumbs, images=np.repeat(thumbs.images[:1], 12, axis=0))
    (finding,) = check_sync(still)
    assert finding.severity == "note"
    assert "clocks: not checkable (what moves covers 0 % of the pictures" in finding.message


def test_recordings_at_hand_raise_no_alarm() -> None:
    names = ("panoptic_basketball_30", "pickblocks_captured_320", "pickblocks_mujoco_320")
    here = [str(RECORDINGS / name) for name in names if (RECORDINGS / name).is_dir()]
    if not here:
        pytest.skip("no recording lies beside the repository")
    for place in here:
        found = validate(partial(open_source, place), frames=10, features=False)
        assert [finding for finding in found if finding.severity != "note"] == [], place


def test_what_a_fault_is_follows_from_its_kind_and_not_from_its_words() -> None:
    """A message may be reworded; the finding's code is a promise to scripts."""
    from gsstream.core.errors import SourceError
    from gsstream.input.prepare.validate import validate
    from gsstream.input.recordings.base import FilesMissing

    def fails(fault: SourceError):
        def open_scene(scale: float):
            raise fault

        return [finding.code for finding in validate(open_scene)]

    assert fails(FilesMissing("reworded")) == ["files"]
    assert fails(SourceError("3 frames are missing from what I think")) == ["calibration"]


@pytest.mark.sfm
@needs_pycolmap
def test_wrong_poses_are_not_taken_for_wrong_clocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Camera-to-world in place of world-to-camera also puts what moves at different places; shifting frames would spoil
    a recording that is in step."""
    from gsstream.input.prepare import validate as module
    from gsstream.input.prepare.findings import error

    write_good(tmp_path / "good")
    folder = spoiled(tmp_path / "good", tmp_path / "bad", next(b for b in BAD if b.name == "camera-to-world"))
    # Whatever the hull of motion makes of these poses: here it blames a clock, as it does on the demo.
    monkeypatch.setattr(module, "check_sync", lambda _: [error("sync", "camera 'cam00' is 3 frames late")])
    found = findings(folder)
    assert [finding.code for finding in found] == ["axes"]
    assert "invert w2c" in found[0].message
    assert [finding.code for finding in findings(tmp_path / "good")] == ["sync"], "with sound poses it is heard"


def test_the_demo_with_inverted_poses_is_told_so_without_features(tmp_path: Path) -> None:
    """Its pictures are too small for features; motion alone must not send its user to the clocks."""
    import shutil

    from gsstream.input.recordings.open import DEMO_FOLDER

    shutil.copytree(DEMO_FOLDER, tmp_path / "c2w")
    path = tmp_path / "c2w" / "cameras.json"
    data = json.loads(path.read_text())
    for camera in data["cameras"]:
        camera["w2c"] = np.linalg.inv(np.array(camera["w2c"])).tolist()
    path.write_text(json.dumps(data))
    found = validate(lambda scale: open_source(str(tmp_path / "c2w"), scale), features=False)
    assert [finding.code for finding in found] == ["axes"]
    assert "invert w2c" in found[0].message
