"""The empty room: what moves is not in its picture, and what is asked for together is refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from live_rig import calibration, encoded, rig_file

from gsstream.cli.main import run_command

SIZE, FPS = (160, 120), 15


def room(camera: int):
    """A ramp that differs from camera to camera."""
    across = np.linspace(40, 200, SIZE[0])[None, :, None] + np.zeros((SIZE[1], 1, 3))
    return np.uint8(across[:, ::-1] if camera else across)


def visited(camera: int, number: int):
    """The room with somebody who walks through it: at each place in an eighth of the pictures."""
    picture, left = room(camera).copy(), 20 * (number % 8)
    picture[:, left : left + 20] = (250, 20, 20)
    return picture


def test_who_moves_is_not_in_the_room(tmp_path, capsys) -> None:
    for camera, name in enumerate("ab"):
        encoded(tmp_path / name, (visited(camera, i) for i in range(FPS * 8)), FPS, suffix="mp4")
    calibration(tmp_path, ["a", "b"], SIZE)
    rig = rig_file(tmp_path, {"a": "a.mp4", "b": "b.mp4"}, FPS)
    assert run_command(["capture", str(rig), "--background", "--out", str(tmp_path / "room")]) == 0
    told = capsys.readouterr().out
    for camera, name in enumerate("ab"):
        count = len(list((tmp_path / "room" / name).glob("0*.jpg")))
        assert count >= 30
        assert f"{name}: background.jpg is the median of {count} pictures" in told
        found = cv2.imread(str(tmp_path / "room" / name / "background.jpg"))[..., ::-1].astype(int)
        seen = cv2.imread(str(tmp_path / "room" / name / "000007.jpg"))[..., ::-1].astype(int)
        assert np.abs(found - room(camera)).mean() < 3
        assert np.abs(seen - room(camera)).mean() > 10, "somebody is in every picture"


@pytest.mark.parametrize("other", [["--raw"], ["--seconds", "3"]])
def test_what_does_not_go_together_is_refused(other, tmp_path, capsys) -> None:
    calibration(tmp_path, ["a"], SIZE)
    rig = rig_file(tmp_path, {"a": "a.mp4"})
    assert run_command(["capture", str(rig), "--background", *other, "--out", str(tmp_path / "room")]) == 2
    assert "leave out --raw and --seconds" in capsys.readouterr().err
