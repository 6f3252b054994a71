"""Rendered pictures of a board: a bent lens, blur and noise, and the truth."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from gsstream_capture.board.adjust import project
from gsstream_capture.board.design import Board
from gsstream_capture.board.start import matrix


@cache
def texture(board: Board, margin: float = 0.3):
    """The board's picture with a white margin of so many squares, how many pixels that is, and those of a square.

    A square has as many as its markers' cells need to be whole: a print has no cell off by a rounding.
    """
    cells, share = board.made().getDictionary().markerSize + 2, board.marker_share
    fine = next(n for n in range(50, 500) if n * share % cells == 0 and n * (1 - share) % 2 == 0)
    drawn = board.made().generateImage((board.columns * fine, board.rows * fine), marginSize=0)
    border = round(margin * fine)
    return cv2.copyMakeBorder(drawn, border, border, border, border, cv2.BORDER_CONSTANT, value=255), border, fine


@cache
def _rays(lens, size):
    """Directions [4 W H, 3] of 2 x 2 samples a pixel."""
    u, v = np.meshgrid((np.arange(2 * size[0]) + 0.5) / 2, (np.arange(2 * size[1]) + 0.5) / 2)
    K = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1]])
    places = np.stack([u.ravel(), v.ravel()], -1)[:, None]
    stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 40, 1e-9)
    ideal = cv2.undistortPoints(places, K, np.array(lens[4:]), criteria=stop).reshape(-1, 2)
    return np.c_[ideal, np.ones(len(ideal))].astype(np.float32)


def rendered(board: Board, lens, pose, size, draw, *, noise=2.0, blur=0.7):
    """[H, W] uint8 of a camera with ``lens`` [9] that sees the board at ``pose`` [4, 4], 2 x 2 samples a pixel."""
    drawn, border, fine = texture(board)
    rays = _rays(tuple(lens), size) @ pose[:3, :3].astype(np.float32)  # in the board's axes
    eye = -pose[:3, :3].T @ pose[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        hit = eye + rays * (-eye[2] / rays[:, 2])[:, None]
    per = fine / (board.square_mm / 1000)
    shape = (2 * size[1], 2 * size[0])
    x = (hit[:, 0] * per + border - 0.5).reshape(shape).astype(np.float32)
    y = (hit[:, 1] * per + border - 0.5).reshape(shape).astype(np.float32)
    sampled = cv2.remap(drawn, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=90)
    picture = cv2.resize(sampled, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    picture = cv2.GaussianBlur(picture, (0, 0), blur)
    return np.uint8(np.clip(np.round(0.7 * picture + 20 + draw.normal(size=picture.shape) * noise), 0, 255))


def places_of(board: Board, lens, pose):
    """Where the corners of the board are, [K, 2] pixels from the corner of the picture."""
    at = board.points @ pose[:3, :3].T + pose[:3, 3]
    return project(np.repeat(np.asarray(lens)[None], len(at), 0), at)[0]


def takes(folder, board: Board, truth, size, *, rig, lens, draw, **noise) -> None:
    """Write takes as they are read: ``rig`` poses of the board in the world, ``lens`` in each camera."""
    for name, one, camera in zip(truth["names"], truth["lenses"], truth["cameras"], strict=True):
        for kind in ("rig", "lens"):
            (folder / kind / name).mkdir(parents=True)
        for number, pose in enumerate(rig):
            picture = rendered(board, one, matrix(camera) @ pose, size, draw, **noise)
            cv2.imwrite(str(folder / "rig" / name / f"{number:06d}.png"), picture)
        for number, pose in enumerate(lens):
            picture = rendered(board, one, pose, size, draw, **noise)
            cv2.imwrite(str(folder / "lens" / name / f"{number:06d}.png"), picture)
