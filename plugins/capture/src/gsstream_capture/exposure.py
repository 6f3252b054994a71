"""How differently cameras expose: what two of them see of the same points, without correcting anything."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import cv2
import numpy as np

from gsstream.core.shapes import FloatArray
from gsstream_capture.pictures import CameraPlan

#: Pixels from the epipolar line within which a match counts; matches that a pair of cameras needs.
NEAR, FEWEST = 2.0, 20
#: How much better than the second best a match must be.
RATIO = 0.75
#: Levels between which a pixel says something about exposure.
DARK, BRIGHT = 12, 243


def gains(pictures: Sequence[Any], plans: Sequence[CameraPlan]) -> FloatArray:
    """Return [C, 3] the gain of each camera against the middle of all, by channel (blue, green, red).

    ``pictures`` [H, W, 3] uint8 are straight and of one instant. NaN where a camera shares too few points with others.
    """
    sift = cv2.SIFT_create(2000)  # type: ignore[attr-defined]
    found = [sift.detectAndCompute(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), None) for picture in pictures]
    smooth = [cv2.GaussianBlur(picture, (0, 0), 2.0).astype(np.float64) for picture in pictures]
    rows, ratios = [], []
    for a, b in combinations(range(len(pictures)), 2):
        places = _matches(found[a], found[b], plans[a], plans[b])
        colours = [_colours(smooth[c], at) for c, at in zip((a, b), places, strict=True)]
        inside = ((np.stack(colours) > DARK) & (np.stack(colours) < BRIGHT)).all(axis=(0, 2))
        if inside.sum() >= FEWEST:
            rows.append((a, b))
            ratios.append(np.median(np.log(colours[1][inside] / colours[0][inside]), axis=0))
    out = np.full((len(pictures), 3), np.nan)
    if not rows:
        return out
    steps = np.zeros((len(rows), len(pictures)))
    for row, (a, b) in enumerate(rows):
        steps[row, a], steps[row, b] = -1, 1
    known = sorted({camera for pair in rows for camera in pair})
    logs = np.linalg.lstsq(steps[:, known], np.stack(ratios), rcond=None)[0]
    out[known] = np.exp(logs - np.median(logs, axis=0))
    return out


def _matches(one: Any, two: Any, first: CameraPlan, second: CameraPlan) -> tuple[FloatArray, FloatArray]:
    """Places [n, 2] and [n, 2] of matches that lie on each other's epipolar lines."""
    none = np.zeros((0, 2)), np.zeros((0, 2))
    if one[1] is None or two[1] is None or len(two[1]) < 2:
        return none
    pairs = cv2.BFMatcher().knnMatch(one[1], two[1], k=2)
    good = [m for m, *rest in pairs if rest and m.distance < RATIO * rest[0].distance]
    if not good:
        return none
    left = np.array([one[0][m.queryIdx].pt for m in good]) + 0.5
    right = np.array([two[0][m.trainIdx].pt for m in good]) + 0.5
    step = second.w2c @ np.linalg.inv(first.w2c)
    t = step[:3, 3]
    essential = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]]) @ step[:3, :3]
    line = np.linalg.inv(second.K).T @ essential @ np.linalg.inv(first.K) @ np.c_[left, np.ones(len(left))].T
    off = np.abs((np.c_[right, np.ones(len(right))] * line.T).sum(1)) / np.maximum(
        np.linalg.norm(line[:2], axis=0), 1e-12
    )
    return left[off < NEAR], right[off < NEAR]


def _colours(picture: FloatArray, places: FloatArray) -> FloatArray:
    column, row = places.astype(int).T
    out: FloatArray = picture[np.clip(row, 0, picture.shape[0] - 1), np.clip(column, 0, picture.shape[1] - 1)]
    return out
