"""From rendered takes of a board, whose truth is known, to a rig: corners, lenses, poses, refusals, files."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from board_views import places_of, rendered, takes
from gsstream_capture.board.design import Board, Finder, Sighting, page, read_board
from gsstream_capture.board.solve import report, solve, solved, write
from gsstream_capture.board.start import matrix
from gsstream_capture.board.takes import Takes, read_takes
from test_board_adjust import circle, errors, rotations

from gsstream.cli.main import run_command
from gsstream.core.errors import SourceError
from gsstream.input.recordings.calibration import read_calibration

SIZE = (640, 480)
BOARD = Board(columns=5, rows=4, square_mm=80)
LENS = np.array([560.0, 563.0, 325.0, 236.0, -0.12, 0.03, 5e-4, -3e-4, 0.0])


def facing(draw, place, *, tilt=0.3, turn=0.0):
    """A pose of the board with its middle at ``place``, turned about y, then tilted at random."""
    pose = np.eye(4)
    pose[:3, :3] = rotations(draw.normal(size=(1, 3)) * tilt)[0] @ rotations(np.array([[0, turn, 0]]))[0]
    pose[:3, 3] = place - pose[:3, :3] @ BOARD.points.mean(0)
    return pose


@pytest.fixture(scope="module")
def taken(tmp_path_factory):
    """Three cameras two metres from a board that is carried between them."""
    folder, draw = tmp_path_factory.mktemp("takes"), np.random.default_rng(2)
    poses, first = circle(9, draw)
    truth = {"names": ["a", "b", "c"], "cameras": poses[:3], "lenses": LENS + np.array([[0.0] * 9] * 3)}
    truth["lenses"][1, :2] += 25
    truth["lenses"][2, 2] += 12
    turn = -2 * np.pi / 9 * 0.55
    rig = [first @ facing(draw, draw.normal(size=3) * 0.12 - [0, 0, 0.3], turn=turn) for _ in range(20)]
    lens = [facing(draw, [*draw.uniform(-0.15, 0.15, 2), draw.uniform(0.5, 0.8)]) for _ in range(12)]
    takes(folder, BOARD, truth, SIZE, rig=rig, lens=lens, draw=draw)
    (folder / "board.yaml").write_text("columns: 5\nrows: 4\nsquare_mm: 80\n")
    return folder, truth


@pytest.mark.parametrize("more", [{}, {"inverted": True}, {"dictionary": "DICT_APRILTAG_36h11"}])
def test_corners_are_where_they_are(more) -> None:
    board, draw = BOARD.model_copy(update=more), np.random.default_rng(0)
    pose = facing(draw, [0.02, 0.03, 0.9])
    picture = rendered(board, LENS, pose, SIZE, draw)
    found = Finder(board).find(255 - picture if board.inverted else picture)
    off = found.places - places_of(board, LENS, pose)[found.ids]
    assert len(found.ids) == 12
    assert np.abs(off).max() < 0.05
    assert np.abs(off.mean(0)).max() < 0.02, "pixels are counted from the corner of the picture"


@pytest.mark.parametrize("turn", [0.3, 0.6, 0.9])
@pytest.mark.parametrize("blur", [0.4, 0.7, 0.9])
def test_corners_of_a_tilted_board_are_where_they_are(turn, blur) -> None:
    """The markers beside them are a few pixels away: OpenCV alone is up to 0.13 pixels off."""
    draw = np.random.default_rng(1)
    pose = facing(draw, [0.1, 0.05, 1.2], tilt=0.1, turn=turn)
    found = Finder(BOARD).find(rendered(BOARD, LENS, pose, SIZE, draw, blur=blur))
    off = found.places - places_of(BOARD, LENS, pose)[found.ids]
    assert len(found.ids) >= 10
    assert np.abs(off).max() < 0.06
    assert np.sqrt((off**2).mean()) < 0.025


def test_what_is_no_corner_is_left_out() -> None:
    """Something bright lies on a corner and around it."""
    pose = facing(np.random.default_rng(0), [0.02, 0.03, 0.9])
    picture = rendered(BOARD, LENS, pose, SIZE, np.random.default_rng(0))
    truth = places_of(BOARD, LENS, pose)
    column, row = truth[5].astype(int)
    picture[row - 12 : row + 12, column - 12 : column + 12] = 250
    found = Finder(BOARD).find(picture)
    assert np.abs(found.places - truth[found.ids]).max() < 0.3


def test_a_board_on_glass_is_read_from_behind() -> None:
    board, draw = BOARD.model_copy(update={"glass": True}), np.random.default_rng(0)
    pose = facing(draw, [0.02, 0.03, 0.9])
    picture = np.ascontiguousarray(rendered(board, LENS, pose, SIZE, draw)[:, ::-1])
    found = Finder(board).find(picture)
    exact = places_of(board, LENS, pose)[found.ids]
    assert np.abs(found.places - np.c_[SIZE[0] - exact[:, 0], exact[:, 1]]).max() < 0.25
    assert Finder(BOARD).find(picture) is None


def test_the_printed_page_is_the_board() -> None:
    """The board is drawn as it is printed, at the size that its file says."""
    sheet = np.asarray(page(BOARD))
    small = cv2.resize(sheet, None, fx=0.2, fy=0.2, interpolation=cv2.INTER_AREA)
    found = Finder(BOARD).find(small)
    assert len(found.ids) == 12
    step = np.linalg.norm(found.places[list(found.ids).index(1)] - found.places[list(found.ids).index(0)])
    assert step == pytest.approx(80 * 10 * 0.2, rel=0.003)


def test_a_rig_is_found(taken, tmp_path, capsys) -> None:
    folder, truth = taken
    out = tmp_path / "cameras.json"
    assert run_command(["calibrate", "board", str(folder), "--out", str(out), "--quiet"]) == 0
    told = capsys.readouterr().out
    assert "WARNING" not in told
    found = read_calibration(tmp_path, growing=True)
    assert found.train.ids == ("a", "b", "c")
    assert json.loads(out.read_text())["units"] == "metres"
    assert np.allclose(found.train.Ks[:, 0, 0], truth["lenses"][:, 0], rtol=0.003)
    assert np.allclose(found.train.Ks[:, 0, 2], truth["lenses"][:, 2], atol=3)
    wanted = np.stack([matrix(pose) for pose in truth["cameras"]])
    centres = [np.linalg.inv(found.train.viewmats)[:, :3, 3], np.linalg.inv(wanted)[:, :3, 3]]
    gaps = [np.linalg.norm(one[:, None] - one[None], axis=-1) for one in centres]
    assert np.abs(gaps[0] - gaps[1]).max() < 0.002, "distances of the cameras are in metres"
    assert (tmp_path / "calibration.txt").read_text() == told[: told.index("wrote")]
    rows = [line.split() for line in told.splitlines()[1:4]]
    assert all(float(row[6]) < 0.6 for row in rows), "held out, pixels"


@pytest.fixture(scope="module")
def read(taken):
    return read_takes(taken[0], lambda *_: None)


def test_angles_and_the_report(taken, read) -> None:
    truth, found = taken[1], solve(read)
    angle, place, focal = errors(found.solution, SimpleNamespace(**{k: truth[k] for k in ("cameras", "lenses")}))
    assert angle < 0.25
    assert place < 0.005
    assert focal < 0.003
    assert (found.deviation < 0.005).all()
    assert "pictures shared" in report(found)


def test_without_a_lens_take_it_says_what_is_loose(read) -> None:
    rig = {key: one for key, one in read.seen.items() if key[1] < read.rig_pictures}
    found = solved(replace(read, seen=rig, pictures=read.rig_pictures, lens_pictures=(0, 0, 0)))
    assert found.loose == ("a", "b", "c")
    assert "WARNING: no lens take of a, b, c" in report(found)


def test_lenses_that_are_known_stay(taken, read, tmp_path) -> None:
    folder, first = taken[0], tmp_path / "first" / "cameras.json"
    write(solve(read), first, 10.0)
    (tmp_path / "lens").mkdir()
    (tmp_path / "lens" / "cameras.json").write_text(first.read_text())
    (tmp_path / "board.yaml").write_text((folder / "board.yaml").read_text())
    (tmp_path / "rig").symlink_to(folder / "rig")
    found = solve(read_takes(tmp_path, lambda *_: None))
    cameras = json.loads(first.read_text())["cameras"]
    assert np.array_equal(found.solution.lenses[:, 0], [camera["K"][0][0] for camera in cameras])
    assert np.array_equal(found.solution.lenses[:, 4:], [camera["distortion"] for camera in cameras])
    assert (found.loose, tuple(found.deviation)) == ((), (0.0, 0.0, 0.0))


def test_a_lens_that_is_not_sure_is_refused() -> None:
    """A dozen pictures, all from the front and far: focal length and distance can hardly be told apart."""
    draw, seen = np.random.default_rng(3), {}
    cameras = [matrix(np.zeros(6)), matrix(np.array([0, 0, 0, 0.1, 0, 0]))]
    for picture in range(12):
        pose = facing(draw, np.array([0, 0, 3.0]) + draw.normal(size=3) * 0.02, tilt=0.02)
        for camera in range(2):
            places = places_of(BOARD, LENS, cameras[camera] @ pose)
            seen[camera, picture] = Sighting(np.arange(12), places + draw.normal(size=places.shape) * 0.1)
    told = Takes(BOARD, ("a", "b"), (SIZE, SIZE), seen, 12, 12, (0, 0), {})
    with pytest.raises(SourceError, match=r"the focal length is not sure to 1 %: 'a' .*close to these cameras"):
        solve(told)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("columns: 2", "columns: .*greater than or equal to 3"),
        ("collumns: 5", "collumns: .*; keys: columns, rows"),
        ("dictionary: DICT_9X9", "dictionary: no 'DICT_9X9'"),
        ("dictionary: DICT_4X4_50\ncolumns: 20\nrows: 20", "has 50 markers, the board needs more"),
        ("[", "cannot be read"),
    ],
)
def test_a_board_file_that_is_wrong(tmp_path, text, message) -> None:
    (tmp_path / "board.yaml").write_text(text)
    with pytest.raises(SourceError, match=message):
        read_board(tmp_path / "board.yaml")


def test_takes_that_are_missing_are_named(taken, tmp_path) -> None:
    folder, _ = taken
    (tmp_path / "board.yaml").write_text((folder / "board.yaml").read_text())
    with pytest.raises(SourceError, match="rig: no such folder"):
        read_takes(tmp_path, lambda *_: None)
    (tmp_path / "rig" / "a").mkdir(parents=True)
    with pytest.raises(SourceError, match="at least two cameras"):
        read_takes(tmp_path, lambda *_: None)


def test_a_board_to_print(tmp_path, capsys) -> None:
    assert run_command(["calibrate", "print", "--out", str(tmp_path / "new"), "--square", "40"]) == 0
    assert read_board(tmp_path / "new" / "board.yaml") == Board(square_mm=40)
    assert (tmp_path / "new" / "board.pdf").read_bytes().startswith(b"%PDF")
