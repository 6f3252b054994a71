"""Is what moves at one place in all cameras at a time? A visual hull of motion, one camera left out at a time.

Where most other cameras see motion, something moves, and the camera that was left out must see motion there too. If it
does so better some frames earlier or later, its clock is off; if it does so with another camera's pose, the two are
swapped.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.projection import inside, project
from gsstream.core.shapes import BoolArray, FloatArray, IntArray
from gsstream.input.prepare.findings import Finding, error
from gsstream.input.prepare.match_checks import REPAIRS
from gsstream.input.prepare.picture_checks import Thumbnails
from gsstream.input.seeds.geometry import depth_range, focus_point
from gsstream.metrics.noise import noise_sigma

GRID = 36
#: Largest offset of a clock that is searched for, frames.
REACH = 3
AGREE, MARGIN = 0.45, 0.15
MIN_VOXELS = 40
VOTES = 0.75


@dataclass(frozen=True, slots=True)
class _Motion:
    """``masks`` [T, C, h w] moving pixels; ``seen`` [V, C] voxel in the image, ``place`` [V, C] its pixel."""

    masks: BoolArray
    seen: BoolArray
    place: IntArray

    def at(self, camera: int, pose: int) -> BoolArray:
        """[T, V]: motion of ``camera`` at the pixels that the voxels have in the view of ``pose``."""
        moving: BoolArray = self.masks[:, camera, self.place[:, pose]] & self.seen[:, pose]
        return moving


def check_sync(thumbs: Thumbnails) -> list[Finding]:
    """Find cameras whose clock is off, and pairs of cameras that are swapped; nothing where too little moves."""
    cameras = thumbs.cameras
    if len(cameras) < 5 or len(thumbs.images) < 2 * REACH + 2:
        return []
    motion = _motion(thumbs)
    votes = _votes(motion)
    total, seen = votes.sum(2), motion.seen.sum(1)
    table = _table(motion, votes)
    out_of_place = [c for c in range(len(cameras)) if 0 <= table[c, REACH] < AGREE and motion.masks[:, c].any()]
    if swapped := _swapped(motion, cameras, out_of_place, total, seen, votes):
        return swapped
    found = []
    for c, row in enumerate(table):
        best = int(row.argmax())
        if best != REACH and row[best] > max(AGREE, row[REACH] + MARGIN):
            late = best - REACH
            found.append(error("sync", (
                f"camera {cameras.ids[c]!r} is {abs(late)} frame{'s' if abs(late) > 1 else ''} "
                f"{'late' if late > 0 else 'early'}: what moves is at another place than in the other cameras. Shift "
                f"its frames by {-late:+d}, or run with --source disturbed:time_offset={cameras.ids[c]}@{late}:SOURCE"
            )))  # fmt: skip
    if found and (better := _better_poses(thumbs, table)):
        return better
    # A clock can only be off against a majority. Where half of the cameras seem to be off, there is too little motion,
    # or too slow a motion, to tell.
    return found if 2 * len(found) < len(cameras) else []


def _votes(motion: _Motion) -> IntArray:
    """[T, V, C] 1 where a camera sees motion in a voxel."""
    return np.stack([motion.at(c, c) for c in range(motion.masks.shape[1])], axis=2).astype(np.int16)


def _table(motion: _Motion, votes: IntArray) -> FloatArray:
    """[C, 2 REACH + 1] scores of every camera against the hull of the others."""
    total, seen = votes.sum(2), motion.seen.sum(1)
    return np.array([
        _scores(_hull(total - votes[:, :, c], seen - motion.seen[:, c]), motion, c) for c in range(votes.shape[2])
    ])  # fmt: skip


def _better_poses(thumbs: Thumbnails, table: FloatArray) -> list[Finding]:
    """Whether poses of another convention put what moves at one place without touching a clock."""
    on_time = _on_time(table)
    for what, cure, repair in REPAIRS:
        poses = np.stack([repair(pose) for pose in thumbs.cameras.viewmats])
        motion = _motion(replace(thumbs, cameras=replace(thumbs.cameras, viewmats=poses)))
        if _on_time(_table(motion, _votes(motion))) > max(AGREE, on_time + MARGIN):
            return [error("axes", (
                f"what moves is at one place in all cameras if the poses are {what}, and at several places as they are "
                f"given: {cure}. Clocks were judged by poses that do not fit"
            ))]  # fmt: skip
    return []


def _on_time(table: FloatArray) -> float:
    """Mean score of the cameras as they are; 0 where fewer than half of them can be judged."""
    known = table[table[:, REACH] >= 0, REACH]
    return float(known.mean()) if 2 * len(known) >= len(table) else 0.0


def _motion(thumbs: Thumbnails) -> _Motion:
    images, cameras = thumbs.images, thumbs.cameras
    height, width = images.shape[2:4]
    cameras = cameras.scaled(width, height)
    masks = np.zeros((len(images) - 1, len(cameras), height, width), bool)
    for c in range(len(cameras)):
        sigma = noise_sigma(images[0, c], images[1, c])
        masks[:, c] = np.abs(np.diff(images[:, c], axis=0)).max(-1) > max(8 / 255, 6 * sigma)
    middle = focus_point(cameras)
    half = 0.5 * float(np.median(depth_range(cameras, near=1.0)[:, 0]))
    axis = np.linspace(-half, half, GRID)
    voxels = middle + np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    seen, place = np.zeros((len(voxels), len(cameras)), bool), np.zeros((len(voxels), len(cameras)), np.int64)
    for c in range(len(cameras)):
        uv, depth = project(voxels, cameras, c)
        seen[:, c] = inside(uv, depth, cameras)
        column, row = np.where(seen[:, c, None], uv, 0).astype(np.int64).T
        place[:, c] = row * width + column
    return _Motion(_grown(masks).reshape(len(masks), len(cameras), -1), seen, place)


def _grown(masks: BoolArray) -> BoolArray:
    """Moving pixels and their four neighbours: thumbnails are coarse and so are voxels."""
    grown = masks.copy()
    grown[..., 1:, :] |= masks[..., :-1, :]
    grown[..., :-1, :] |= masks[..., 1:, :]
    grown[..., 1:] |= masks[..., :-1]
    grown[..., :-1] |= masks[..., 1:]
    return grown


def _hull(votes: IntArray, watched: IntArray) -> BoolArray:
    """[T, V] voxels in which at least three cameras, and most of those that see them, see motion."""
    hull: BoolArray = (votes >= 3) & (votes >= VOTES * watched)
    return hull


def _scores(hull: BoolArray, motion: _Motion, c: int) -> FloatArray:
    """[2 REACH + 1] share of the hull's voxels in which camera c sees motion so many frames later; -1: not known."""
    mine, frames = motion.at(c, c), len(hull)
    # Every offset is judged by the same frames.
    core = hull[REACH : frames - REACH] & motion.seen[None, :, c]
    if int(core.sum()) < MIN_VOXELS:
        return np.full(2 * REACH + 1, -1.0)
    return np.array([float(mine[o : o + len(core)][core].mean()) for o in range(2 * REACH + 1)])


def _swapped(
    motion: _Motion, cameras: Cameras, lost: list[int], total: IntArray, seen: IntArray, votes: IntArray
) -> list[Finding]:
    """Pairs of cameras, each of which fits the motion that the rest sees when it has the other's pose."""
    found = []
    for a in lost:
        for b in lost:
            if b <= a:
                continue
            hull = _hull(total - votes[:, :, a] - votes[:, :, b], seen - motion.seen[:, a] - motion.seen[:, b])
            fits = []
            for camera, pose in ((a, b), (b, a)):
                where = hull & motion.seen[None, :, pose]
                fits.append(float(motion.at(camera, pose)[where].mean()) if int(where.sum()) >= MIN_VOXELS else 0.0)
            if min(fits) > AGREE + MARGIN:
                found.append(error("sync", (
                    f"cameras {cameras.ids[a]!r} and {cameras.ids[b]!r} are swapped: each sees what moves where the "
                    "other should; exchange their images or their poses"
                )))  # fmt: skip
    return found
