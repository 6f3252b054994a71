"""Two takes of a board: close to each camera for its lens, and carried through the room for the poses.

::

    takes/board.yaml            the board that was printed
    takes/lens/ID.mp4           the board fills the picture of camera ID; or a folder of pictures, lens/ID/*.jpg
    takes/lens/cameras.json     or lenses that are known from earlier, which stay as they are
    takes/rig/ID.mp4            pictures of one number are of one instant in all cameras; or folders, rig/ID/*.jpg
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gsstream.core.errors import SourceError
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.calibration import CALIBRATION_FILE, read_calibration
from gsstream.input.recordings.video import VideoClip
from gsstream_capture.board.design import Board, Finder, Sighting, read_board

BOARD_FILE, LENS, RIG = "board.yaml", "lens", "rig"
#: Number of pictures, evenly over a take, in which the board is looked for.
MOST = 240
_VIDEOS, _PICTURES = (".mp4", ".mov", ".mkv", ".avi"), (".jpg", ".jpeg", ".png")
_NUMBER = re.compile(r"(\d+)(?!.*\d)")

#: What is being done, how many pictures are done, and of how many.
Tell = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class Takes:
    """What all cameras saw of the board; pictures of the lens takes are numbered after those of the rig take."""

    board: Board
    names: tuple[str, ...]
    sizes: tuple[tuple[int, int], ...]
    seen: dict[tuple[int, int], Sighting]
    pictures: int
    rig_pictures: int
    lens_pictures: tuple[int, ...]  # of the lens take of each camera, in which the board was seen
    known: dict[int, FloatArray]  # camera -> fx, fy, cx, cy, k1, k2, p1, p2, k3 that are known


def read_takes(folder: Path, tell: Tell) -> Takes:
    """Find the board in the takes of a folder.

    Raises SourceError where a take is missing, or the cameras of the two takes differ.
    """
    board = read_board(folder / BOARD_FILE)
    rig = _clips(folder / RIG)
    if len(rig) < 2:
        raise SourceError(f"{folder / RIG}: expected a video or a folder of pictures for each of at least two cameras")
    lens = _clips(folder / LENS) if (folder / LENS).is_dir() else {}
    earlier = _known(folder / LENS, tuple(rig))
    if unknown := sorted(set(lens) - set(rig)):
        raise SourceError(f"{folder / LENS}: camera {unknown[0]!r} has no take in {folder / RIG}")
    names, finder = tuple(rig), Finder(board)
    seen: dict[tuple[int, int], Sighting] = {}
    sizes: list[tuple[int, int]] = []
    numbers = _common(rig)
    for camera, name in enumerate(names):
        size: tuple[int, int] | None = None
        for picture, pixels in _read(rig[name], numbers, f"looking at {name}", tell):
            size = _same_size(size, pixels, rig[name])
            if (found := finder.find(pixels)) is not None:
                seen[camera, picture] = found
        if size is None:
            raise SourceError(f"{rig[name]}: no pictures")
        sizes.append(size)
    count, counts = len(numbers), [0] * len(names)
    for camera, name in enumerate(names):
        if name not in lens:
            continue
        for _, pixels in _read(lens[name], _spread(_numbers(lens[name])), f"lens of {name}", tell):
            _same_size(sizes[camera], pixels, lens[name])
            if (found := finder.find(pixels)) is not None:
                seen[camera, count] = found
                count, counts[camera] = count + 1, counts[camera] + 1
    return Takes(board, names, tuple(sizes), seen, count, len(numbers), tuple(counts), earlier)


def _known(folder: Path, names: tuple[str, ...]) -> dict[int, FloatArray]:
    """Lenses of an earlier calibration, by camera. Raises SourceError for a faulty file, or a fisheye."""
    if not (folder / CALIBRATION_FILE).exists():
        return {}
    found = read_calibration(folder, growing=True, any_sizes=True)
    rig = found.train.joined(found.test)
    known = {}
    for camera, name in enumerate(names):
        if name not in rig.ids:
            continue
        K, lens = rig.Ks[rig.ids.index(name)], found.lenses.get(name)
        if lens is not None and (lens.kind != "radial" or len(lens.k) > 3):
            raise SourceError(f"{folder / CALIBRATION_FILE}: camera {name!r}: expected a lens of k1, k2, p1, p2, k3")
        k = (*(lens.k if lens else ()), 0.0, 0.0, 0.0)[:3]
        p = lens.p if lens else (0.0, 0.0)
        known[camera] = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], k[0], k[1], *p, k[2]])
    return known


def _clips(folder: Path) -> dict[str, Path]:
    """Camera -> its video or its folder of pictures."""
    if not folder.is_dir():
        raise SourceError(f"{folder}: no such folder; it holds ID.mp4 or a folder ID of pictures for each camera")
    found = {}
    for path in sorted(folder.iterdir()):
        if path.is_dir() or path.suffix.lower() in _VIDEOS:
            found[path.stem if path.is_file() else path.name] = path
    return found


def _numbers(clip: Path) -> list[int]:
    if clip.is_dir():
        return sorted(_files(clip))
    video = VideoClip(clip)
    video.close()
    return list(video.numbers)


def _files(folder: Path) -> dict[int, Path]:
    pictures = (path for path in folder.iterdir() if path.suffix.lower() in _PICTURES)
    return {int(match[1]): path for path in pictures if (match := _NUMBER.search(path.stem))}


def _common(clips: dict[str, Path]) -> list[int]:
    """Numbers of which at least two cameras have a picture."""
    counted: dict[int, int] = {}
    for clip in clips.values():
        for number in _numbers(clip):
            counted[number] = counted.get(number, 0) + 1
    return _spread(sorted(number for number, count in counted.items() if count > 1))


def _spread(numbers: list[int]) -> list[int]:
    if len(numbers) <= MOST:
        return numbers
    return [numbers[i] for i in np.unique(np.linspace(0, len(numbers) - 1, MOST).astype(int))]


def _read(clip: Path, numbers: list[int], what: str, tell: Tell) -> Iterator[tuple[int, Any]]:
    """(place in ``numbers``, [H, W, 3] uint8) of each picture that is there."""
    if clip.is_dir():
        files = _files(clip)
        for place, number in enumerate(numbers):
            tell(what, place + 1, len(numbers))
            if number in files:
                pixels = cv2.imread(str(files[number]), cv2.IMREAD_COLOR)
                if pixels is None:
                    raise SourceError(f"{files[number]}: the picture cannot be decoded")
                yield place, pixels
        return
    video = VideoClip(clip)
    try:
        for place, number in enumerate(numbers):
            tell(what, place + 1, len(numbers))
            if number < video.num_frames:
                pixels = video.read(number, video.size)
                eight = pixels if pixels.dtype == np.uint8 else np.round(255 * pixels).astype(np.uint8)
                yield place, np.ascontiguousarray(eight[..., ::-1])
    finally:
        video.close()


def _same_size(known: tuple[int, int] | None, pixels: Any, clip: Path) -> tuple[int, int]:
    size = (int(pixels.shape[1]), int(pixels.shape[0]))
    if known is not None and known != size:
        raise SourceError(f"{clip}: a picture is {size[0]} x {size[1]}, others of this camera {known[0]} x {known[1]}")
    return size
