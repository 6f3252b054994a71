"""Calibration against the pictures: matched features must lie on each other's epipolar lines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.shapes import FloatArray
from gsstream.input.prepare.findings import Finding, error, note
from gsstream.input.seeds.matching import PairMatches

#: Median distance to the epipolar line above which a camera is wrong, as a share of the image width (2 px of 640).
TOLERANCE = 2 / 640
MIN_MATCHES = 30
#: Share of a camera's matches in pairs that contradict the poses, above which the camera is to blame.
MAX_WRONG = 0.65

Repair = Callable[[FloatArray], FloatArray]
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
REPAIRS: tuple[tuple[str, str, Repair], ...] = (
    ("camera-to-world matrices", "invert w2c", np.linalg.inv),
    ("OpenGL world-to-camera matrices (y up, z backwards)", "multiply rows 2 and 3 of w2c by -1", lambda m: _FLIP @ m),
    (
        "OpenGL camera-to-world matrices (as in nerfstudio)",
        "multiply columns 2 and 3 by -1 and invert",
        lambda m: np.linalg.inv(m @ _FLIP),
    ),
)


def check_matches(cameras: Cameras, pairs: list[PairMatches], *, rig_only: bool = False) -> list[Finding]:
    """Check every camera by the matches with all others."""
    pairs = [pair for pair in pairs if len(pair.first) >= MIN_MATCHES]
    limit = max(1.0, TOLERANCE * cameras.width)
    if len(pairs) < 2:
        return [
            note(
                "epipolar",
                f"the pictures of frame 0 share too few features to check the calibration ({len(pairs)} pairs of "
                f"cameras with at least {MIN_MATCHES} matches); look at the first frame of a run instead",
            )
        ]
    bad = _suspect_cameras(cameras, pairs, limit)
    involved = {camera for pair in pairs for camera in pair.cameras}
    if not bad:
        return []
    if 2 * len(bad) > len(involved) - 1:
        return _whole_rig(cameras, pairs, limit)
    if rig_only:
        return []
    return _each(cameras, pairs, bad, limit)


def _suspect_cameras(cameras: Cameras, pairs: list[PairMatches], limit: float) -> list[int]:
    """Cameras most of whose matches, in at least two pairs, contradict the poses; the worst first.

    Matches count, not pairs: wide pairs with few matches often agree on a geometry that is none (repeated texture, one
    plane) and must not outvote the good ones. Pairs of an accused camera accuse nobody else.
    """
    wrong = [float(np.median(epipolar_errors(cameras, pair))) > limit for pair in pairs]
    left, accused = list(range(len(pairs))), []
    while left:
        total, against, count = (np.zeros(len(cameras)) for _ in range(3))
        for k in left:
            for camera in pairs[k].cameras:
                total[camera] += len(pairs[k].first)
                against[camera] += len(pairs[k].first) * wrong[k]
                count[camera] += 1
        share = np.where(count >= 2, against / np.maximum(total, 1), 0)
        worst = int(share.argmax())
        if share[worst] <= MAX_WRONG:
            break
        accused.append(worst)
        left = [k for k in left if worst not in pairs[k].cameras]
    return accused


def epipolar_errors(cameras: Cameras, pair: PairMatches) -> FloatArray:
    """Return [M]: distance of matched positions to the epipolar lines of their partners, pixels.

    It is the mean of both images.
    """
    a, b = pair.cameras
    relative = cameras.viewmats[b] @ np.linalg.inv(cameras.viewmats[a])
    x, y, z = relative[:3, 3]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    F = np.linalg.inv(cameras.Ks[b]).T @ cross @ relative[:3, :3] @ np.linalg.inv(cameras.Ks[a])
    one = np.ones((len(pair.first), 1))
    first, second = np.hstack([pair.first, one]), np.hstack([pair.second, one])
    in_second, in_first = first @ F.T, second @ F
    product = np.abs((second * in_second).sum(1))
    lengths = [np.maximum(np.linalg.norm(lines[:, :2], axis=1), 1e-12) for lines in (in_second, in_first)]
    mean: FloatArray = product * (1 / lengths[0] + 1 / lengths[1]) / 2
    return mean


def _fits(cameras: Cameras, pairs: list[PairMatches], limit: float) -> bool:
    """Whether nearly all matches lie in pairs that agree with the poses."""
    good = [len(pair.first) * (float(np.median(epipolar_errors(cameras, pair))) <= limit) for pair in pairs]
    return sum(good) > 0.7 * sum(len(pair.first) for pair in pairs)


def _whole_rig(cameras: Cameras, pairs: list[PairMatches], limit: float) -> list[Finding]:
    for what, repair, change in REPAIRS:
        poses = np.stack([change(pose) for pose in cameras.viewmats])
        if _fits(replace(cameras, viewmats=poses), pairs, limit):
            return [
                error("epipolar", (f"the pictures contradict the poses, but fit when w2c is read as {what}: {repair}"))
            ]
    usual = float(np.median([np.median(epipolar_errors(cameras, pair)) for pair in pairs]))
    return [
        error(
            "epipolar",
            f"the pictures contradict the calibration: matches lie {usual:.1f} pixels off their epipolar lines in "
            f"most pairs of cameras, expected at most {limit:.1f}; calibrate again, or let 'gsstream scene "
            "prepare' do so",
        )
    ]


def _each(cameras: Cameras, pairs: list[PairMatches], bad: list[int], limit: float) -> list[Finding]:
    found = []
    for c in sorted(bad):
        inner, outer, middle = _by_radius(cameras, pairs, c)
        text = (
            f"matches lie {middle:.1f} pixels off their epipolar lines, expected at most {limit:.1f}; its pose or K is "
            "wrong: calibrate it again"
        )
        if outer > 3 * inner and inner < limit:
            text = (
                f"matches lie {inner:.1f} pixels off their epipolar lines in the middle of the image and {outer:.1f} "
                "towards its corners, as of a lens whose distortion was not removed: undistort its images "
                "(gsstream scene prepare)"
            )
        found.append(error("epipolar", f"camera {cameras.ids[c]!r}: {text}"))
    return found


def _by_radius(cameras: Cameras, pairs: list[PairMatches], c: int) -> tuple[float, float, float]:
    """Median error of a camera's matches in the inner and in the outer half of its image, and of all."""
    radii, values = [], []
    for pair in pairs:
        if c in pair.cameras:
            mine = pair.first if pair.cameras[0] == c else pair.second
            radii.append(np.linalg.norm(mine - cameras.Ks[c, :2, 2], axis=1))
            values.append(epipolar_errors(cameras, pair))
    radius, value = np.concatenate(radii), np.concatenate(values)
    middle = np.median(radius)
    inner, outer = value[radius <= middle], value[radius >= middle]
    return float(np.median(inner)), float(np.median(outer)), float(np.median(value))
