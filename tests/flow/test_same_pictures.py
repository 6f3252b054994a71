"""A run that goes on is given the pictures that its stream was made from, or says that it is not."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest
from flow_runs import arguments, demo_copy, encode, metrics

from gsstream.cli.main import run_command
from gsstream.engine.run.same_pictures import DIGITS, PICTURES
from gsstream.packet import StreamReader

SMALL = {"stream__epochs": 2, "first_frame__max_iterations": 8, "first_frame__max_points": 200}


def frames_of(out: Path) -> int:
    with StreamReader(out / "stream.gss") as reader:
        return len(reader.frames)


def turned_round(folder: Path) -> None:
    """Rename the pictures of every camera, so that the last one comes first."""
    for camera in sorted(folder.glob("cam*/")):
        pictures = sorted(camera.iterdir())
        held = [picture.read_bytes() for picture in pictures]
        for picture, data in zip(pictures, reversed(held), strict=True):
            picture.write_bytes(data)


def gone_on(out: Path, source: Path | str, *more: str) -> int:
    return run_command(arguments(out, "--frames", "3", "--resume", *more, source=str(source), **SMALL))


@pytest.fixture
def begun(tmp_path: Path) -> Path:
    demo_copy(tmp_path / "take1")
    encode(tmp_path / "out", "--frames", "2", source=str(tmp_path / "take1"), **SMALL)
    assert [len(line[PICTURES]) for line in metrics(tmp_path / "out")] == 2 * [3 * DIGITS]
    return tmp_path


def test_another_take_of_the_same_cameras_is_refused(begun: Path, capsys: pytest.CaptureFixture[str]) -> None:
    demo_copy(begun / "take2")
    turned_round(begun / "take2")
    said = (begun / "out" / "recording.txt").read_bytes()
    assert gone_on(begun / "out", begun / "take2") == 2
    error = capsys.readouterr().err
    assert "frame 1 of 'take2' shows other pictures" in error
    assert "'take1'" in error
    assert frames_of(begun / "out") == 2
    assert (begun / "out" / "recording.txt").read_bytes() == said


def test_one_camera_of_another_recording_is_enough(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    encode(tmp_path / "out", "--frames", "2", source="disturbed:drift=cam02@-0.05:demo", **SMALL)
    assert gone_on(tmp_path / "out", "demo") == 2
    assert "frame 1 of 'demo' shows other pictures" in capsys.readouterr().err


def test_a_recording_that_was_renamed_goes_on(begun: Path) -> None:
    (begun / "take1").rename(begun / "moved")
    assert gone_on(begun / "out", begun / "moved") == 0
    assert frames_of(begun / "out") == 3


def test_other_pictures_in_the_same_place_are_told(begun: Path, capsys: pytest.CaptureFixture[str]) -> None:
    turned_round(begun / "take1")
    assert gone_on(begun / "out", begun / "take1") == 0
    assert "warning: frame 1 of 'take1' shows other pictures" in capsys.readouterr().err


def test_a_picture_that_was_mended_is_none_of_a_new_recording(begun: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pictures = sorted((begun / "take1" / "cam02").iterdir())
    pictures[1].write_bytes(pictures[2].read_bytes())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert gone_on(begun / "out", begun / "take1") == 0
    assert "other pictures" not in capsys.readouterr().err
