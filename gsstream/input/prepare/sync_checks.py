"""Do all cameras show the same instants? Motion on epipolar lines is compared between cameras at shifted times.

A camera that is most like all others some frames earlier or later has a clock that is off; two cameras that are like
the others only with each other's pose are swapped. A finding says so where there is too little motion, or too steady a
motion, to tell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.shapes import FloatArray
from gsstream.input.prepare.findings import Finding, error, note
from gsstream.input.prepare.line_motion import Motion, barcodes, likeness, motions
from gsstream.input.prepare.match_checks import REPAIRS
from gsstream.input.prepare.picture_checks import Thumbnails
from gsstream.input.seeds.geometry import neighbour_views

#: Offsets are searched for up to this share of the frames; every offset is then compared over most of them.
REACH = 0.3
#: Cameras that each camera is compared with.
PARTNERS = 12
#: A clock counts as known from this correlation with the other cameras on, if the correlation falls by at least the
#: second number away from the best offset.
ALIKE, FALL = 0.3, 0.05
#: Least offset that is claimed, frames; least gain of correlation by an offset; least gain times the number of frames
#: squared (a few frames prove little); least share of the partners that agree.
LEAST, GAIN, GAIN_OF_FEW, VOTES = 0.7, 0.01, 12.0, 0.75
#: So many of the cameras that are least like the others, and clearly less than usual, are tried with each other's pose;
#: both must become so much more like the others.
SUSPECTS, STAND_OUT, EXCHANGED = 6, 0.92, 0.1


@dataclass(frozen=True, slots=True)
class Clock:
    """By how many frames one camera is ``late``; None: not known. ``ended``: the best lies at the end of the search."""

    late: float | None
    ended: bool = False


def check_sync(thumbs: Thumbnails) -> list[Finding]:
    """Find cameras whose clock is off and pairs that are swapped; a note where that cannot be known."""
    height, width = thumbs.images.shape[2:4]
    cameras, reach = thumbs.cameras.scaled(width, height), int(REACH * len(thumbs.images))
    if len(thumbs.images) < 2:
        return []  # a still scene has no clocks
    if len(cameras) < 3 or reach < 1:
        have = f"{len(cameras)} cameras, {len(thumbs.images)} frames"
        return [note("sync", f"clocks: not checkable ({have}; expected at least 3 and 4)")]
    seen = motions(thumbs)
    curves = _curves(cameras, seen, reach)
    clocks = _clocks(curves, len(thumbs.images))
    if swapped := _swapped(cameras, seen, curves[:, :, reach]):
        return swapped
    lost = [c for c, clock in enumerate(clocks) if clock.late is None]
    off = [c for c, clock in enumerate(clocks) if clock.late]
    if 2 * (len(off) + len(lost)) >= len(cameras) and (better := _better_poses(cameras, seen, curves)):
        return better
    # A clock can only be off against a majority.
    if 2 * len(off) >= len(cameras) - len(lost):
        lost = list(range(len(cameras)))
        off = []
    return [_told(cameras.ids[c], clocks[c], reach) for c in off] + _unknown(cameras, seen, lost)


def _told(name: str, clock: Clock, reach: int) -> Finding:
    late = round(clock.late or 0)
    count = f"{f'at least {reach}' if clock.ended else abs(late)} frame{'s' if abs(late) > 1 else ''}"
    cure = f"Shift its frames by {-late:+d}, or run with --source disturbed:time_offset={name}@{late}:SOURCE"
    if clock.ended:
        cure = f"No larger offset was tried; more are with --frames {math.ceil(2 * reach / REACH)}"
    return error(
        "sync",
        f"camera {name!r} is {count} {'late' if late > 0 else 'early'}: what moves is at another place than in the "
        f"other cameras. {cure}",
    )


def _unknown(cameras: Cameras, seen: list[Motion], lost: list[int]) -> list[Finding]:
    if not lost:
        return []
    share = 100 * float(np.mean([seen[c].share for c in lost]))
    which = "" if len(lost) == len(cameras) else f" of {', '.join(cameras.ids[c] for c in lost)}"
    return [
        note(
            "sync",
            f"clocks{which}: not checkable (what moves covers {share:.2g} % of the pictures from one frame to the "
            "next); more frames may show more",
        )
    ]


def _curves(cameras: Cameras, seen: list[Motion], reach: int) -> FloatArray:
    """[C, C, 2 reach + 1] how like camera b is to camera a so many frames later; NaN where they are not compared."""
    count = len(cameras)
    curves = np.full((count, count, 2 * reach + 1), np.nan)
    for a, b in sorted({(min(pair), max(pair)) for pair in _pairs(cameras)}):
        if codes := barcodes(cameras, (a, b), (seen[a], seen[b])):
            curves[a, b] = likeness(*codes, reach)
            curves[b, a] = curves[a, b, ::-1]
    return curves


def _pairs(cameras: Cameras) -> list[tuple[int, int]]:
    return [(a, int(b)) for a, partners in enumerate(neighbour_views(cameras, PARTNERS)) for b in partners]


def _clocks(curves: FloatArray, frames: int) -> list[Clock]:
    """The clock of every camera: the largest offset first, whose camera then no longer weighs on the others."""
    count, reach, least = len(curves), curves.shape[2] // 2, max(GAIN, GAIN_OF_FEW / frames**2)
    moved = np.zeros(count, int)
    for _ in range(count):
        rows = [_row(curves, c, moved) for c in range(count)]
        gains = [_gain(row, reach + moved[c], least) for c, row in enumerate(rows)]
        worst = int(np.argmax(gains))
        if gains[worst] <= 0:
            break
        moved[worst] = int(np.nanargmax(rows[worst].mean)) - reach
    return [_clock(_row(curves, c, moved), reach, least) for c in range(count)]


@dataclass(frozen=True, slots=True)
class _Row:
    """``each`` [P, 2 reach + 1] likeness to every partner, its clock set right; ``mean`` over them."""

    each: FloatArray
    mean: FloatArray


def _row(curves: FloatArray, c: int, moved: FloatArray) -> _Row:
    each = np.full(curves.shape[1:], np.nan)
    for a, shift in enumerate(moved):
        inside = slice(max(0, shift), each.shape[1] + min(0, shift))
        each[a, inside] = curves[a, c, max(0, -shift) : each.shape[1] - max(0, shift)]
    return _Row(each, _mean(each))


def _mean(values: FloatArray) -> FloatArray:
    """Mean over the first axis of what is known; NaN where nothing is."""
    known = np.isfinite(values)
    count = known.sum(0)
    mean: FloatArray = np.where(count > 0, np.where(known, values, 0).sum(0) / np.maximum(count, 1), np.nan)
    return mean


def _gain(row: _Row, now: int, least: float) -> float:
    """How much more like the others a camera is at its best offset than at ``now``; 0 where that is not sure."""
    if np.isnan(row.mean).all() or np.isnan(row.mean[now]):
        return 0.0
    best = int(np.nanargmax(row.mean))
    better = row.each[:, best] - row.each[:, now]
    better = better[np.isfinite(better)]
    gain = float(row.mean[best] - row.mean[now])
    sure = gain >= least and row.mean[best] >= ALIKE and float((better > 0).mean()) >= VOTES
    return gain if sure and abs(_peak(row.mean) - now) >= LEAST else 0.0


def _clock(row: _Row, reach: int, least: float) -> Clock:
    known = row.mean[np.isfinite(row.mean)]
    if not len(known) or known.max() < ALIKE or known.max() - known.min() < FALL:
        return Clock(None)
    if not _gain(row, reach, least):
        return Clock(0.0)
    peak = _peak(row.mean)
    return Clock(peak - reach, ended=round(peak) in (0, 2 * reach))


def _peak(mean: FloatArray) -> float:
    """Where a curve is highest, between its samples."""
    best = int(np.nanargmax(mean))
    if not 0 < best < len(mean) - 1 or not np.isfinite(mean[best - 1 : best + 2]).all():
        return float(best)
    left, top, right = mean[best - 1 : best + 2]
    return best + 0.5 * float((left - right) / min(left - 2 * top + right, -1e-12))


def _fit(cameras: Cameras, seen: list[Motion], camera: int, pose: int, without: tuple[int, int]) -> float:
    """How like the others a camera is, at the same instants, if it stands at ``pose``."""
    others = [c for a, c in _pairs(cameras) if a == pose and c not in without]
    codes = [barcodes(cameras, (c, pose), (seen[c], seen[camera])) for c in others]
    found = [float(likeness(*code, 0)[0]) for code in codes if code is not None]
    known = [value for value in found if np.isfinite(value)]
    return float(np.mean(known)) if known else 0.0


def _swapped(cameras: Cameras, seen: list[Motion], now: FloatArray) -> list[Finding]:
    """Pairs of cameras, each of which is more like the others when it has the other's pose.

    ``now``: [C, C] likeness of each pair as they are.
    """
    mean = _mean(now)
    own = np.where(np.isfinite(mean), mean, 0.0)  # a camera that was compared with no other is like none of them
    suspects = [int(c) for c in np.argsort(own)[:SUSPECTS] if own[c] < STAND_OUT * np.median(own)]
    found = []
    for a, b in combinations(sorted(suspects), 2):
        changed = min(_fit(cameras, seen, x, pose=y, without=(a, b)) - own[x] for x, y in ((a, b), (b, a)))
        if changed > EXCHANGED and min(own[a], own[b]) + changed > ALIKE:
            found.append(
                error(
                    "sync",
                    f"cameras {cameras.ids[a]!r} and {cameras.ids[b]!r} are swapped: each sees what moves where "
                    "the other should; exchange their images or their poses",
                )
            )
    return found


def _better_poses(cameras: Cameras, seen: list[Motion], curves: FloatArray) -> list[Finding]:
    """Whether poses of another convention put what moves at one place without touching a clock."""
    given = _on_time(curves)
    for what, cure, repair in REPAIRS:
        poses = np.stack([repair(pose) for pose in cameras.viewmats])
        if _on_time(_curves(replace(cameras, viewmats=poses), seen, 0)) > max(ALIKE, 1.5 * given):
            return [
                error(
                    "axes",
                    f"what moves is at one place in all cameras if the poses are {what}, and at several places as "
                    f"they are given: {cure}. Clocks were compared by poses that do not fit",
                )
            ]
    return []


def _on_time(curves: FloatArray) -> float:
    """Mean likeness of the cameras as they are."""
    now = curves[:, :, curves.shape[2] // 2]
    return float(np.nanmean(now)) if np.isfinite(now).any() else 0.0
