"""How differently cameras expose, by what two see of the same points; corrected only where a rig asks for it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import cv2
import numpy as np
from scipy.sparse.csgraph import connected_components

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

    ``pictures`` [H, W, 3] uint8 are straight and of one instant. NaN where a camera shares too few points with others,
    and for all but the largest group of cameras that share points.
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
    steps, links = np.zeros((len(rows), len(pictures))), np.eye(len(pictures))
    for row, (a, b) in enumerate(rows):
        steps[row, a], steps[row, b], links[a, b] = -1, 1, 1
    # Two groups of cameras that share nothing say nothing of each other: the larger one counts.
    group = connected_components(links, directed=False)[1]
    known = np.flatnonzero(group == np.bincount(group).argmax())
    inside = np.isin([a for a, _ in rows], known)
    logs = np.linalg.lstsq(steps[inside][:, known], np.stack(ratios)[inside], rcond=None)[0]
    out[known] = np.exp(logs - np.median(logs, axis=0))
    return out


def matched(pictures: Sequence[Any], plans: Sequence[CameraPlan], say: Callable[[str], None]) -> list[CameraPlan]:
    """Return plans that divide each camera's colours by its gain; who shares too little is told, and left as it is.

    ``pictures`` as for :func:`gains`, written by these plans.
    """
    out = []
    for plan, gain in zip(plans, gains(pictures, plans), strict=True):
        if np.isnan(gain).any():
            say(f"exposure of {plan.name} is not matched: too few points that others see, too")
            out.append(plan)
            continue
        say(f"exposure of {plan.name} is matched: it was {percents(gain)} beside the others")
        out.append(replace(plan, gain=(float(gain[0]), float(gain[1]), float(gain[2]))))
    return out


def percents(gain: FloatArray) -> str:
    """Return a gain by channel, as a difference."""
    return ", ".join(f"{name} {100 * (g - 1):+.0f} %" for name, g in zip(("blue", "green", "red"), gain, strict=True))


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
