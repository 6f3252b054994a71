"""A clip: the pictures of one camera, by frame number. Here are image files, and the search for them and for videos."""

from __future__ import annotations

import glob
import itertools
import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from PIL import Image

from gsstream.core.errors import SourceError
from gsstream.input.recordings.base import FilesMissing
from gsstream.input.recordings.images import (
    PICTURE_FORMATS,
    UNDECODABLE,
    check_photograph,
    is_deep,
    read_stored,
    told_apart,
)
from gsstream.input.recordings.video import VideoClip

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
VIDEO_SUFFIXES = (".mp4", ".mov", ".mkv", ".avi", ".webm", ".ts")


class Clip(Protocol):
    """The pictures of one camera. Reading is thread-safe and repeatable bit for bit."""

    @property
    def files(self) -> Sequence[Path]:
        """Its pictures in order, or the video alone."""

    @property
    def where(self) -> str:
        """File or folder, for messages."""

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""

    @property
    def num_frames(self) -> int: ...

    @property
    def numbers(self) -> Sequence[int]:
        """Numbers of the pictures, ascending, where files are numbered; else counted from 0."""

    @property
    def deep(self) -> bool:
        """Whether pictures have more than 8 bits per channel."""

    def read(self, index: int, target: tuple[int, int]) -> Any:
        """Read [h, w, 3], area-averaged to ``target`` (width, height); ``index`` counts from 0.

        uint8, of which 255 is 1.0, of 8 bits at their size; else float32 in [0, 1].
        """

    def close(self) -> None:
        """Close what stays open between reads."""


class ImageClip:
    """Image files in the given order, 8 or 16 bit, with these ascending ``numbers``; None: counted from 0.

    Raises SourceError when a file is missing or the first one is not an image.
    """

    def __init__(self, files: Sequence[Path], numbers: Sequence[int] | None = None) -> None:
        self.files, self.num_frames, self.where = tuple(files), len(files), str(files[0].parent)
        self.numbers: Sequence[int] = range(len(files)) if numbers is None else tuple(numbers)
        if missing := [path for path in files if not path.is_file()]:
            raise FilesMissing(
                f"{missing[0]}: the picture is missing ({len(missing)} of {len(files)} of this camera are); restore it"
            )
        self.size, self.deep = _opened(files[0])

    def read(self, index: int, target: tuple[int, int]) -> Any:
        return read_stored(self.files[index], self.size, target, "the first image of its camera has")

    def close(self) -> None:
        """Do nothing: no file stays open between reads."""


def _opened(path: Path) -> tuple[tuple[int, int], bool]:
    """(width, height) of a picture, and whether it is deep."""
    try:
        with Image.open(path, formats=PICTURE_FORMATS) as image:
            check_photograph(path, image)
            return image.size, is_deep(path)
    except SourceError:  # is a ValueError, too
        raise
    except UNDECODABLE as error:
        raise SourceError(
            f"{path}: the image cannot be opened ({error}); expected PNG or JPEG; {told_apart(path)}"
        ) from error


def prepare_command(source: str) -> str:
    """Return the command that makes a scene of a recording which cannot be run as it is, for messages."""
    source = source.partition("?")[0]
    out = Path(source.rpartition(":")[2]).resolve().name + "-prepared"
    return f"gsstream scene prepare {shlex.quote(source)} --out {shlex.quote(out)}"


def natural_sort_key(path: Path) -> list[tuple[int, str]]:
    """Sort key: cam_2 before cam_10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name) if part]


def files_in(folder: Path, suffixes: Sequence[str]) -> list[Path]:
    """Return the files of a folder with these suffixes, of any case, in natural order; empty without such a folder.

    Hidden files are passed over: file managers leave some (``._NAME`` beside NAME) that are no pictures.
    """
    if not folder.is_dir():
        return []
    shown = (path for path in folder.iterdir() if not path.name.startswith("."))
    return sorted((path for path in shown if path.suffix.lower() in suffixes), key=natural_sort_key)


def images_in(folder: Path) -> list[Path]:
    """Return the image files of a folder, in natural order; empty when there is no such folder."""
    return files_in(folder, IMAGE_SUFFIXES)


def folders_in(folder: Path) -> list[Path]:
    """Return the folders of a folder that are not hidden, in natural order; empty when there is no such folder."""
    inside = folder.iterdir() if folder.is_dir() else ()
    return sorted((p for p in inside if p.is_dir() and not p.name.startswith(".")), key=natural_sort_key)


def clips_in(places: Sequence[Path]) -> dict[str, Clip]:
    """Return camera -> clip of the first of these folders that holds two cameras or more; empty where none does.

    Looked for in this order: a video per camera, a folder of pictures per camera, a picture per camera.
    """
    for place in places:
        if len(videos := files_in(place, VIDEO_SUFFIXES)) > 1:
            return {name: VideoClip(path) for name, path in _by_stem(videos).items()}
    for place in places:
        if len(cameras := [path for path in folders_in(place) if images_in(path)]) > 1:
            return {path.name: folder_clip(path) for path in cameras}
    for place in places:
        if len(pictures := images_in(place)) > 1:
            return {name: ImageClip([path]) for name, path in _by_stem(pictures).items()}
    return {}


def clip_at(place: Path) -> Clip | None:
    """Return the pictures of a folder, or the video that is called so, whatever its suffix; None where neither is."""
    if images_in(place):
        return folder_clip(place)
    named = sorted(path for path in place.parent.glob(f"{glob.escape(place.name)}.*") if path.stem == place.name)
    return next((VideoClip(path) for path in named if path.suffix.lower() in VIDEO_SUFFIXES), None)


def listed_clips(pictures: Mapping[str, Sequence[Path]]) -> dict[str, Clip]:
    """Return the clips of cameras whose pictures a file lists, instant by instant.

    Where the pictures of all cameras have the same ascending numbers, those count, so that a gap is seen.
    """
    numbers = {name: [_number(path) for path in files] for name, files in pictures.items()}
    first = next(iter(numbers.values()), [])
    known = [number for number in first if number is not None]
    shared = len(known) == len(first) and known == sorted(set(known)) and all(n == first for n in numbers.values())
    return {name: ImageClip(files, known if shared else None) for name, files in pictures.items()}


def _by_stem(files: list[Path]) -> dict[str, Path]:
    found: dict[str, Path] = {}
    for path in files:
        if path.stem in found:
            raise SourceError(f"{path} and {found[path.stem].name}: two files of one camera; leave one of them there")
        found[path.stem] = path
    return found


def folder_clip(folder: Path) -> ImageClip:
    """Return all images of a folder as one camera's frames; the last number in a name is the frame number.

    Raises SourceError for an empty folder, for a name without a number and for two files of one number.
    """
    files = images_in(folder)
    if not files:
        raise SourceError(f"{folder}: no images; expected frames as PNG or JPEG files")
    numbers = [_number(path) for path in files]
    if len(files) == 1:
        return ImageClip(files, [numbers[0] or 0])
    known = [number for number in numbers if number is not None]
    if len(known) < len(files):
        odd = files[numbers.index(None)]
        raise SourceError(f"{odd}: expected a frame number at the end of the name, e.g. 000012.png")
    ordered = sorted(zip(known, files, strict=True), key=lambda pair: pair[0])
    for (number, path), (following, other) in itertools.pairwise(ordered):
        if following == number:
            raise SourceError(f"{folder}: frame {number} is there twice: {path.name} and {other.name}")
    return ImageClip([path for _, path in ordered], [number for number, _ in ordered])


def _number(path: Path) -> int | None:
    found = re.findall(r"\d+", path.stem)
    return int(found[-1]) if found else None
