"""A first guess of lenses and poses, from which the bundle adjustment begins, and who saw the board together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from gsstream.core.errors import SourceError
from gsstream.core.shapes import FloatArray, IntArray
from gsstream_capture.board.adjust import Solution, rotations
from gsstream_capture.board.design import Board, Sighting

#: Pictures of the board that a camera needs, and that it needs to share with the cameras before it.
FEWEST_PICTURES, FEWEST_SHARED = 8, 10
#: Pictures that the first guess of a lens uses: more take long and change little.
MOST_FOR_LENS = 40

#: (camera, picture) -> what was seen.
Sightings = Mapping[tuple[int, int], Sighting]


def first_lens(board: Board, seen: Sequence[Sighting], size: tuple[int, int], name: str) -> FloatArray:
    """Return fx, fy, cx, cy, k1, k2, p1, p2, k3 of a camera. Raises SourceError where the board was seen too rarely."""
    if len(seen) < FEWEST_PICTURES:
        raise SourceError(
            f"camera {name!r} saw the board in {len(seen)} pictures, at least {FEWEST_PICTURES} are needed: carry it "
            "nearer, more slowly, and into all corners of its picture"
        )
    chosen = [seen[i] for i in np.unique(np.linspace(0, len(seen) - 1, MOST_FOR_LENS).astype(int))]
    points = [board.points[one.ids].astype(np.float32) for one in chosen]
    places = [one.places.astype(np.float32) for one in chosen]
    guess = np.array([[max(size), 0, size[0] / 2], [0, max(size), size[1] / 2], [0, 0, 1.0]])
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3
    _, K, bent, _, _ = cv2.calibrateCamera(points, places, size, guess, np.zeros(5), flags=flags)
    k1, k2, p1, p2, _ = np.asarray(bent).ravel()[:5]
    return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], k1, k2, p1, p2, 0.0])


def board_pose(board: Board, one: Sighting, lens: FloatArray) -> FloatArray:
    """Return the pose of the board in a camera: rotation vector and translation [6]."""
    K = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1.0]])
    _, turn, shift = cv2.solvePnP(board.points[one.ids], one.places, K, lens[4:], flags=cv2.SOLVEPNP_ITERATIVE)
    return np.concatenate([turn.ravel(), shift.ravel()])


def shared(seen: Sightings, cameras: int) -> IntArray:
    """Return [C, C]: in how many pictures two cameras saw the board together; on the diagonal, in how many each did."""
    pictures = [{picture for camera, picture in seen if camera == c} for c in range(cameras)]
    return np.array([[len(a & b) for b in pictures] for a in pictures])


def first_guess(
    board: Board, seen: Sightings, lenses: FloatArray, names: Sequence[str], pictures: int
) -> tuple[Solution, IntArray]:
    """Return poses of cameras and boards by walking from camera to camera, most shared pictures first; and ``shared``.

    Raises SourceError naming the camera that shares too few pictures with the others.
    """
    poses = {key: board_pose(board, one, lenses[key[0]]) for key, one in seen.items()}
    links = shared(seen, len(names))
    cameras = {0: np.eye(4)}
    while len(cameras) < len(names):
        others = [c for c in range(len(names)) if c not in cameras]
        inner, new = max(((a, b) for a in cameras for b in others), key=lambda pair: links[pair])
        if links[inner, new] < FEWEST_SHARED:
            best = max(others, key=lambda c: links[list(cameras), c].max())
            raise SourceError(
                f"camera {names[best]!r} saw the board together with another camera in {links[inner, new]} pictures, "
                f"at least {FEWEST_SHARED} are needed: hold it where {names[inner]!r} and {names[best]!r} both see it"
            )
        both = [p for p in range(pictures) if (inner, p) in seen and (new, p) in seen]
        steps = [_matrix(poses[new, p]) @ np.linalg.inv(_matrix(poses[inner, p])) for p in both]
        cameras[new] = _middle(steps) @ cameras[inner]
    boards = np.zeros((pictures, 6))
    for picture in range(pictures):
        best = max(range(len(names)), key=lambda c: len(seen[c, picture].ids) if (c, picture) in seen else -1)
        if (best, picture) not in seen:
            continue
        boards[picture] = vector(np.linalg.inv(cameras[best]) @ _matrix(poses[best, picture]))
    return Solution(lenses, np.stack([vector(cameras[c]) for c in range(len(names))]), boards), links


def _matrix(pose: FloatArray) -> FloatArray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotations(pose[None, :3])[0], pose[3:]
    return out


matrix = _matrix


def vector(pose: FloatArray) -> FloatArray:
    """[4, 4] -> rotation vector and translation [6]."""
    return np.concatenate([cv2.Rodrigues(pose[:3, :3])[0].ravel(), pose[:3, 3]])


def _middle(steps: Sequence[FloatArray]) -> FloatArray:
    """The one of several that is nearest to most others: a flat board seen from afar may be turned the wrong way."""
    stack = np.stack(steps)
    traces = np.einsum("aij,bij->ab", stack[:, :3, :3], stack[:, :3, :3])
    angles = np.arccos(np.clip((traces - 1) / 2, -1, 1))
    shifts = np.linalg.norm(stack[:, None, :3, 3] - stack[None, :, :3, 3], axis=-1)
    unit = max(float(np.median(np.linalg.norm(stack[:, :3, 3], axis=-1))), 1e-9)
    out: FloatArray = stack[int(np.median(angles + shifts / unit, axis=1).argmin())]
    return out
