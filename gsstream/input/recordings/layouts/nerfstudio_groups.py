"""Which entries of a transforms.json are the frames of one camera: by folder, or by pose and intrinsics."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from gsstream.core.errors import SourceError
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.clips import natural_sort_key

#: Elements of poses that differ by less, beside a share of 1e-5, are those of one camera.
_NEAR = 1e-9
Entry = dict[str, Any]
Pose = Callable[[Path, Entry], FloatArray]
#: Keys of an entry that say how its camera sees.
INTRINSICS = (
    "fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_angle_y", "x_fov", "y_fov", "k1", "k2", "k3", "k4",
    "k5", "k6", "p1", "p2", "camera_model", "is_fisheye",
)  # fmt: skip


def group_entries(path: Path, frames: list[Entry], pose: Pose) -> dict[str, list[Entry]]:
    """Return camera id -> its entries, in the order of ``time`` (numbers, where they are there), else of names.

    One folder per camera with one pose each; else entries of one pose and one set of intrinsics, where ``time`` (or
    equal numbers of them) says that they are a recording; else one camera per entry, a still scene.

    Raises SourceError for a camera that moves, and for cameras that are not all there at all times.
    """
    by_folder: dict[str, list[Entry]] = {}
    poses, first = np.stack([pose(path, frame) for frame in frames]), dict[str, int]()
    firsts = []
    for i, frame in enumerate(frames):
        folder = str(PurePosixPath(frame["file_path"]).parent)
        by_folder.setdefault(folder, []).append(frame)
        firsts.append(first.setdefault(folder, i))
    still = np.allclose(poses, poses[firsts], atol=_NEAR)
    if still and len(by_folder) > 1:
        names = [PurePosixPath(folder).name for folder in by_folder]
        if len(set(names)) < len(names):
            names = [folder.replace("/", "_") for folder in by_folder]
        cameras = dict(zip(names, by_folder.values(), strict=True))
        timed = max(map(len, cameras.values())) > 1 and all("time" in frame for frame in frames)
        return _checked(path, cameras) if timed else _sorted(cameras)
    groups = _by_pose(frames, poses)
    times = {_time(frame) for frame in frames if "time" in frame}
    sizes = {len(entries) for entries in groups}
    if len(times) > 1:
        return _timed(path, groups, len(times))
    if len(sizes) == 1 and sizes != {1}:
        return _sorted(_named(groups))
    if 2 * sum(len(entries) for entries in groups if len(entries) > 1) > len(frames):
        raise SourceError(
            f"{path}: pictures share {len(groups)} poses, {min(sizes)} to {max(sizes)} of them each: a recording with "
            "holes? Expected as many for every camera, or 'time' in every entry"
        )
    single = {PurePosixPath(frame["file_path"]).stem: [frame] for frame in frames}
    if len(single) < len(frames) or len(by_folder) > 1:
        raise SourceError(
            f"{path}: a folder of frames has several poses: a camera that moves. Expected one camera per entry (a "
            "video, a folder of frames or one image), one folder per camera with one pose, or 'time' in every entry"
        )
    return _sorted(single)


def _timed(path: Path, groups: list[list[Entry]], instants: int) -> dict[str, list[Entry]]:
    """Cameras of a recording in one flat folder, or in folders of instants, whose entries say when."""
    if max(map(len, groups)) == 1:
        raise SourceError(
            f"{path}: {len(groups)} pictures of {instants} times, each from another pose: a camera that moves. "
            "Expected cameras that stand still, each with a picture of every time"
        )
    return _checked(path, _named(groups))


def _checked(path: Path, cameras: dict[str, list[Entry]]) -> dict[str, list[Entry]]:
    """The cameras, once each of them has one picture of every time that any of them has."""
    every = {_time(entry) for entries in cameras.values() for entry in entries}
    for name, entries in cameras.items():
        own = [_time(entry) for entry in entries]
        if len(set(own)) < len(own):
            twice = next(time for time in own if own.count(time) > 1)
            raise SourceError(f"{path}: camera {name!r} has two pictures of time {twice:g}; take one of them out")
        if lacking := sorted(every - set(own)):
            raise SourceError(
                f"{path}: camera {name!r} has no picture of time {lacking[0]:g} ({len(lacking)} of {len(every)} times "
                "are missing; a camera that moves would look like this, too): restore it, or take the camera or that "
                "time out of the file"
            )
    return _sorted(cameras)


def _by_pose(frames: list[Entry], poses: FloatArray) -> list[list[Entry]]:
    """Entries whose pose and intrinsics agree, in the order of the file."""
    # Thousands of poses are sorted by one number each, so that only poses with nearly the same number are compared.
    flat = poses.reshape(len(poses), -1)
    weights = np.sqrt(np.arange(flat.shape[1]) + 2)
    keys, slack = flat @ weights, (_NEAR + 1e-5 * np.abs(flat)) @ weights
    groups: list[list[int]] = []
    firsts = np.zeros(len(frames), np.int64)
    for i, frame in enumerate(frames):
        known = firsts[: len(groups)]
        near = np.flatnonzero(np.abs(keys[known] - keys[i]) <= slack[known])
        same = near[np.isclose(flat[i], flat[known[near]], atol=_NEAR).all(1)]
        found = next((g for g in same if _lens(frames[firsts[g]]) == _lens(frame)), None)
        if found is None:
            firsts[len(groups)] = i
            groups.append([i])
        else:
            groups[found].append(i)
    return [[frames[i] for i in group] for group in groups]


def _lens(entry: Entry) -> list[Any]:
    return [entry.get(key) for key in INTRINSICS]


def _named(groups: Sequence[list[Entry]]) -> dict[str, list[Entry]]:
    """Cameras are named by what their files' names have in common; where that tells them not apart, by number."""
    stems = [[PurePosixPath(entry["file_path"]).stem for entry in entries] for entries in groups]
    ways: tuple[Callable[[str], str], ...] = (
        lambda stem: stem,
        lambda stem: re.sub(r"[_\-. ]*\d+$", "", stem),
        lambda stem: re.sub(r"^\d+[_\-. ]*", "", stem),
        lambda stem: re.sub(r"^[A-Za-z]+[_\-. ]?\d+[_\-. ]+", "", stem),
    )
    for way in ways:
        kinds = [{way(stem) for stem in own} for own in stems]
        names = [next(iter(kind)) for kind in kinds]
        if all(len(kind) == 1 for kind in kinds) and len(set(names)) == len(names) and all(names):
            return dict(zip(names, groups, strict=True))
    return {f"cam{number:02d}": entries for number, entries in enumerate(groups)}


def _sorted(cameras: dict[str, list[Entry]]) -> dict[str, list[Entry]]:
    ordered = {name: sorted(entries, key=_when) for name, entries in cameras.items()}
    return dict(sorted(ordered.items(), key=lambda item: natural_sort_key(Path(item[0]))))


def _time(entry: Entry) -> float:
    return float(entry.get("time", 0.0))


def _when(entry: Entry) -> tuple[float, list[tuple[int, str]]]:
    return _time(entry), natural_sort_key(Path(entry["file_path"]))
