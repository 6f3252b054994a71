"""Bundle adjustment: derivatives against differences, and rigs whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest
from gsstream_capture.board.adjust import (
    Corners,
    Solution,
    adjust,
    adjust_twice,
    focal_deviation,
    project,
    residuals,
    rotations,
)
from gsstream_capture.board.design import Board, Sighting
from gsstream_capture.board.start import first_guess, matrix, vector

from gsstream.core.errors import SourceError

LENS = np.array([1000.0, 1012.0, 641.0, 359.0, -0.2, 0.08, 1e-3, -2e-3, 0.01])
BOARD = Board()


def circle(cameras, draw, distance=2.0):
    """Cameras around a place, two metres from it, which look at it: poses [C, 6] with the first as the world."""
    poses = []
    for k in range(cameras):
        turn = 2 * np.pi * k / cameras * 0.55
        place = distance * np.array([np.sin(turn), 0.3 * np.sin(3 * turn), -np.cos(turn)])
        forward = -place / np.linalg.norm(place)
        right = np.cross([0, 1, 0], forward)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ place
        poses.append(pose)
    to_first = np.linalg.inv(poses[0])
    return np.stack([vector(pose @ to_first) for pose in poses]), poses[0]


def look(seen, key, lens, pose, draw, *, noise, size=(1280, 720)):
    """What a camera sees of a board at a pose, where it sees enough from the front."""
    at = BOARD.points @ pose[:3, :3].T + pose[:3, 3]
    if (at[:, 2] < 0.1).any() or pose[2, 2] < 0.35:
        return False
    places = project(np.repeat(lens[None], len(at), 0), at)[0]
    ids = np.flatnonzero(((places > 4) & (places < np.array(size) - 4)).all(1))
    if len(ids) >= 8:
        seen[key] = Sighting(ids, places[ids] + draw.normal(size=(len(ids), 2)) * noise)
    return len(ids) >= 8


def walk(cameras, pictures, *, noise, seed=0, close=0):
    """A board that is carried through the middle: truth, and what the cameras see of it."""
    draw = np.random.default_rng(seed)
    poses, first = circle(cameras, draw)
    lenses = LENS + draw.normal(size=(cameras, 9)) * np.array([30, 30, 8, 8, 0.02, 0.02, 5e-4, 5e-4, 0.01])
    boards, seen = [], {}
    for picture in range(pictures):
        turn = 2 * np.pi * 0.55 * draw.uniform(-0.1, 1.0)
        pose = np.eye(4)
        face = np.array([np.sin(turn), 0, -np.cos(turn)])
        tilt = draw.normal(size=3) * 0.35
        down = np.array([0, 1.0, 0])
        across = np.cross(down, -face)
        base = np.stack([across, down, -face], 1)
        pose[:3, :3] = rotations(tilt[None])[0] @ base
        pose[:3, 3] = draw.normal(size=3) * 0.25 - pose[:3, :3] @ BOARD.points.mean(0)
        boards.append(vector(first @ pose))
        for camera in range(cameras):
            look(seen, (camera, picture), lenses[camera], matrix(poses[camera]) @ matrix(boards[-1]), draw, noise=noise)
    for camera in range(cameras):  # and close to each camera, for its lens
        for _ in range(close):
            pose = np.eye(4)
            pose[:3, :3] = rotations(draw.normal(size=(1, 3)) * 0.35)[0]
            pose[:3, 3] = [*draw.uniform(-0.15, 0.15, 2), draw.uniform(0.3, 0.6)] - pose[:3, :3] @ BOARD.points.mean(0)
            if look(seen, (camera, len(boards)), lenses[camera], pose, draw, noise=noise):
                boards.append(vector(np.linalg.inv(matrix(poses[camera])) @ pose))
    return Solution(lenses, poses, np.stack(boards)), seen


def corners_of(seen):
    rows = [
        (np.full(len(s.ids), c), np.full(len(s.ids), p), BOARD.points[s.ids], s.places) for (c, p), s in seen.items()
    ]
    return Corners(*(np.concatenate(column) for column in zip(*rows, strict=True)))


def errors(found, truth):
    """Largest error of a camera's direction (degrees), its place (metres) and its focal length (share).

    The rigs are laid over each other first, turned and moved but not scaled.
    """
    a, b = (np.stack([np.linalg.inv(matrix(pose)) for pose in rig.cameras]) for rig in (found, truth))
    middles = a[:, :3, 3].mean(0), b[:, :3, 3].mean(0)
    u, _, v = np.linalg.svd(sum(p[:3, :3] @ q[:3, :3].T for p, q in zip(a, b, strict=True)))
    turn = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
    pairs = [(turn.T @ p[:3, :3], q[:3, :3]) for p, q in zip(a, b, strict=True)]
    angles = [np.degrees(np.arccos(np.clip((np.trace(p.T @ q) - 1) / 2, -1, 1))) for p, q in pairs]
    places = np.linalg.norm((a[:, :3, 3] - middles[0]) @ turn - (b[:, :3, 3] - middles[1]), axis=1)
    return max(angles), places.max(), float(np.abs(found.lenses[:, 0] / truth.lenses[:, 0] - 1).max())


def test_derivatives_are_those_of_differences() -> None:
    draw = np.random.default_rng(3)
    truth, seen = walk(3, 4, noise=0.5)
    corners = corners_of(seen)
    start = Solution(truth.lenses, truth.cameras + draw.normal(size=truth.cameras.shape) * 0.02, truth.boards + 0.01)
    _, by = residuals(start, corners)
    step = 1e-6
    for part, columns in (("lenses", range(9)), ("cameras", range(9, 15)), ("boards", range(15, 21))):
        for place, column in enumerate(columns):
            sides = []
            for sign in (1, -1):
                moved = {name: getattr(start, name).copy() for name in ("lenses", "cameras", "boards")}
                moved[part][:, place] += sign * step
                sides.append(residuals(Solution(**moved), corners)[0])
            slope = (sides[0] - sides[1]) / (2 * step)
            assert np.allclose(by[:, :, column], slope, rtol=1e-4, atol=1e-3 * max(1, np.abs(slope).max() * 1e-3)), (
                column
            )


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 0.3, 3.0, np.pi - 1e-6])
def test_rotations_are_those_of_opencv(angle) -> None:
    import cv2

    axis = np.array([0.6, -0.48, 0.64])
    assert np.allclose(rotations((angle * axis)[None])[0], cv2.Rodrigues(angle * axis)[0], atol=1e-12)


def test_without_noise_the_truth_is_found() -> None:
    truth, seen = walk(4, 60, noise=0.0)
    names = [f"cam{c}" for c in range(4)]
    rough = truth.lenses * np.array([1.02, 1.02, 1.01, 0.99, 0.8, 0, 0, 0, 0])
    start, links = first_guess(BOARD, seen, rough, names, 60)
    angle, place, focal = errors(adjust(start, corners_of(seen)), truth)
    assert (angle, place, focal) < (1e-5, 1e-6, 1e-6)
    assert place < 1e-6
    assert (links == links.T).all()


def test_twelve_cameras_with_noise_are_found() -> None:
    """Poses within 0.05 degrees and 0.5 mm at two metres, from corners that are 0.1 pixels off."""
    truth, seen = walk(12, 150, noise=0.1, close=25)
    names = [f"cam{c}" for c in range(12)]
    rough = truth.lenses * np.array([1.01, 1.01, 1.0, 1.0, 0.9, 0.5, 0, 0, 0])
    start, _ = first_guess(BOARD, seen, rough, names, len(truth.boards))
    corners = corners_of(seen)
    found = adjust(start, corners)
    angle, place, focal = errors(found, truth)
    print(angle, place, focal)
    assert angle < 0.05
    assert place < 0.0005
    assert focal < 0.002
    deviation = focal_deviation(found, corners)
    off = np.abs(found.lenses[:, 0] / truth.lenses[:, 0] - 1)
    assert (off < 4 * deviation).all(), "the deviation that is told is the one that is"
    assert np.median(off) > 0.1 * np.median(deviation)


def test_the_deviation_knows_that_the_corners_of_a_picture_are_off_together() -> None:
    """A board that moved between two cameras' exposures: half a pixel, in one direction for all of a picture."""
    ratios = []
    for seed in range(3):
        truth, seen = walk(4, 80, noise=0.1, close=12, seed=seed)
        draw = np.random.default_rng(seed)
        moved = {key: Sighting(one.ids, one.places + 0.5 * draw.normal(size=2)) for key, one in seen.items()}
        start, _ = first_guess(BOARD, moved, truth.lenses, list("abcd"), len(truth.boards))
        corners = corners_of(moved)
        found = adjust(start, corners)
        ratios += list((found.lenses[:, 0] / truth.lenses[:, 0] - 1) / focal_deviation(found, corners))
    assert 0.4 < np.sqrt(np.mean(np.square(ratios))) < 1.6


def test_a_few_false_corners_move_nothing() -> None:
    truth, seen = walk(4, 60, noise=0.1, close=15)
    draw = np.random.default_rng(5)
    corners = corners_of(seen)
    place = corners.place.copy()
    false = draw.choice(len(place), len(place) // 100, replace=False)
    place[false] += draw.normal(size=(len(false), 2)) * 30
    start, _ = first_guess(BOARD, seen, truth.lenses, list("abcd"), len(truth.boards))
    found, kept = adjust_twice(start, Corners(corners.camera, corners.picture, corners.point, place))
    exact, all_kept = adjust_twice(start, corners)
    assert kept.sum() >= 0.985 * len(place)
    assert not kept[false[np.linalg.norm(place - corners.place, axis=1)[false] > 5]].any()
    assert all_kept.mean() > 0.999
    assert errors(found, exact)[0] < 0.02
    assert errors(found, exact)[1] < 0.0005


def test_a_camera_that_shares_too_little_is_named() -> None:
    truth, seen = walk(3, 60, noise=0.1)
    others = {picture for camera, picture in seen if camera != 2}
    alone = {key: one for key, one in seen.items() if key[0] != 2 or key[1] not in others}
    with pytest.raises(SourceError, match=r"camera 'c' saw the board together .* in 0 pictures, at least 10"):
        first_guess(BOARD, alone, truth.lenses, list("abc"), 60)
