"""A folder with cameras.json (schema "opencv-multiview-1"): its images or videos, and optional points_frame0.npz."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from gsstream.core.errors import SourceError
from gsstream.input.recordings.base import FilesMissing, PointKind
from gsstream.input.recordings.calibration import CALIBRATION_FILE, Calibration, frame_path, is_video, read_calibration
from gsstream.input.recordings.clips import Clip, ImageClip
from gsstream.input.recordings.pointfiles import POINTS_FILE, read_points
from gsstream.input.recordings.recorded import Recording, SeenPoints
from gsstream.input.recordings.video import VideoClip


def looks_like(folder: Path) -> bool:
    """Say whether there is a cameras.json, which counts whatever else the folder holds."""
    return (folder / CALIBRATION_FILE).is_file()


def read(folder: Path) -> Recording:
    """Read the calibration and open its pictures. Raises SourceError for a faulty calibration and what is missing."""
    known = read_calibration(folder, any_sizes=True)
    check_files(folder, known)
    train, test = known.train, known.test
    rig = train.joined(test)
    return Recording(
        name=known.name,
        where=str(folder / CALIBRATION_FILE),
        rig=rig,
        clips={name: _clip(folder, known, name) for name in rig.ids},
        test=test.ids,
        fps=known.fps,
        lenses=known.lenses,
        sizes=known.sizes,
        points=lambda kind: _points(folder, known, kind),
        licence=known.licence,
    )


def _clip(folder: Path, known: Calibration, name: str) -> Clip:
    pattern = known.patterns[name]
    if not is_video(pattern):
        numbers = frame_numbers(folder, pattern, known.num_frames)
        return ImageClip([folder / frame_path(pattern, number) for number in numbers], numbers)
    return VideoClip(folder / pattern, known.num_frames or None)


def _points(folder: Path, known: Calibration, kind: PointKind) -> SeenPoints | None:
    """The points that ship. Every training camera counts as having taken part, since the file does not say which."""
    path = folder / POINTS_FILE
    if not path.exists():
        return None
    cloud, taking_part = read_points(path, kind), [True] * len(known.train) + [False] * len(known.test)
    return SeenPoints(cloud, np.broadcast_to(taking_part, (len(cloud), len(taking_part))))


def check_files(folder: Path, calibration: Calibration) -> None:
    """Raise SourceError for what is declared and is not there, before anything is trained on what is."""
    for camera_id in (*calibration.train.ids, *calibration.test.ids):
        pattern = calibration.patterns[camera_id]
        if is_video(pattern):
            if not (folder / pattern).is_file():
                raise FilesMissing(f"{folder}: camera {camera_id!r} has no video; expected {folder / pattern}")
            continue
        if "%" not in pattern and calibration.num_frames > 1:
            raise SourceError(
                f"{folder}: camera {camera_id!r}: {calibration.num_frames} frames are declared, but 'frames' "
                f"{pattern!r} names a single image; use a pattern such as %06d, or name a video"
            )
        _check_images(folder, camera_id, pattern, calibration.num_frames)


def _check_images(folder: Path, camera_id: str, pattern: str, count: int) -> None:
    _check_span(folder, camera_id, pattern, count)
    numbers = frame_numbers(folder, pattern, count)
    if len(numbers) < count:
        there = frozenset(numbers)
        path = folder / frame_path(pattern, next(t for t in range(count + 1) if t not in there))
        if not numbers:
            raise FilesMissing(f"{folder}: camera {camera_id!r} has no frames; expected {path} and its followers")
        raise FilesMissing(
            f"{folder}: camera {camera_id!r}: {count - len(numbers)} of {count} frames are missing, the first is "
            f'{path}; restore them or lower "frames" in cameras.json'
        )


def frame_numbers(folder: Path, pattern: str, count: int) -> Sequence[int]:
    """Return the numbers of a camera's first ``count`` images, ascending; fewer where there are fewer.

    They need not begin at 0, nor follow each other: what other cameras have decides whether one is missing.
    """
    if all((folder / frame_path(pattern, number)).is_file() for number in range(count)):
        return range(count)
    return list(itertools.islice(numbers_there(folder, pattern), count))


def numbers_there(folder: Path, pattern: str, above: int = -1) -> Iterator[int]:
    """Yield the numbers above ``above`` of which a camera has an image, ascending, whichever those are."""
    parts = PurePosixPath(pattern).parts
    place = folder.joinpath(*itertools.takewhile(lambda part: "%" not in part, parts[:-1]))
    names = [path.name for path in place.iterdir()] if place.is_dir() else []
    numbers = {int(digits) for name in names for digits in re.findall(r"\d+", name)}
    for number in sorted(numbers):
        if number > above and (folder / frame_path(pattern, number)).is_file():
            yield number


def _check_span(folder: Path, camera_id: str, pattern: str, count: int) -> None:
    """The first and the last image first: a count of millions is answered at once, without a list of names."""
    for index in (0, count - 1):
        path = folder / frame_path(pattern, index)
        try:
            there = path.is_file()
        except OSError as error:
            raise SourceError(f"{folder}: camera {camera_id!r}: {str(path)[:100]}...: {error.strerror}") from error
        if not there and count > 100_000:
            raise FilesMissing(f"{folder}: camera {camera_id!r}: {count} frames are declared, but {path} is missing")
