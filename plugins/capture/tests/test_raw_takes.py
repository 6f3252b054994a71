"""Takes are captured without a calibration, and the hint says where the board has not been."""

from __future__ import annotations

import cv2
import numpy as np
from board_views import rendered
from gsstream_capture.board.design import Board, Sighting
from gsstream_capture.board.hint import Hint
from gsstream_capture.board.takes import read_takes
from live_rig import encoded
from test_board_takes import LENS, facing

from gsstream.cli.main import run_command

BOARD, SIZE = Board(columns=5, rows=4, square_mm=80), (640, 480)


def test_raw_pictures_are_takes(tmp_path, capsys) -> None:
    """Two films of a board, turned by the rig file; what is written is read as a take."""
    draw = np.random.default_rng(1)
    pictures = [
        rendered(BOARD, LENS, facing(draw, [0.05, 0, 0.9]), SIZE, draw)[..., None].repeat(3, 2) for _ in range(6)
    ]
    encoded(tmp_path / "a", (pictures[i % 6] for i in range(34)), 15, suffix="mp4")
    encoded(tmp_path / "b", (np.rot90(pictures[i % 6]) for i in range(34)), 15, suffix="mp4")
    rig = tmp_path / "rig.yaml"
    rig.write_text("fps: 15\ncameras:\n- {id: a, url: a.mp4}\n- {id: b, url: b.mp4, rotate: 90}\n")
    folder = tmp_path / "takes"
    folder.mkdir()
    (folder / "board.yaml").write_text("columns: 5\nrows: 4\nsquare_mm: 80\n")
    assert run_command(["capture", str(rig), "--raw", "--out", str(folder / "rig")]) == 0
    told = capsys.readouterr().out
    assert "a: " in told
    assert "pictures of the board" in told
    assert not (folder / "rig" / "cameras.json").exists()
    one, two = (cv2.imread(str(folder / "rig" / name / "000003.jpg")).astype(int) for name in "ab")
    assert one.shape == two.shape == (480, 640, 3)
    assert np.abs(one - two).mean() < 3
    found = read_takes(folder, lambda *_: None)
    assert found.rig_pictures >= 25
    assert len(found.seen) >= 50


def test_the_hint_names_the_corner_that_lacks() -> None:
    hint = Hint(BOARD, ["left", "right"])
    for x in range(16):
        for y in range(16):
            if x >= 8 or y < 8:
                hint.saw(0, Sighting(np.arange(1), np.array([[40.0 * x + 20, 30.0 * y + 15]])), SIZE)
            if x >= 8 and y < 4:
                hint.saw(1, Sighting(np.arange(1), np.array([[40.0 * x + 20, 30.0 * y + 15]])), SIZE)
    assert hint.covered(0) == 0.75
    assert hint.lines()[0].endswith("75 % covered")
    assert "12 % covered; lacks the " in hint.lines()[1]
    assert "upper right" not in hint.lines()[1]
