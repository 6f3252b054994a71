"""A clip: the pictures of one camera, by frame number. Here: image files; videos are in ``video``."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

from PIL import Image, UnidentifiedImageError

from gsstream.core.errors import SourceError
from gsstream.input.recordings.base import FilesMissing
from gsstream.input.recordings.images import PICTURE_FORMATS, is_deep, read_stored, told_apart

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
VIDEO_SUFFIXES = (".mp4", ".mov", ".mkv", ".avi", ".webm")


class Clip(Protocol):
    """The pictures of one camera. Reading is thread-safe and repeatable bit for bit."""

    @property
    def where(self) -> str:
        """File or folder, for messages."""

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""

    @property
    def num_frames(self) -> int: ...

    @property
    def first(self) -> int:
        """Number of the first picture, where files are numbered; else 0."""

    @property
    def deep(self) -> bool:
        """Whether pictures have more than 8 bits per channel."""

    def read(self, index: int, target: tuple[int, int]) -> Any:
        """Read [h, w, 3], area-averaged to ``target`` (width, height); ``index`` counts from 0.

        uint8, of which 255 is 1.0, of 8 bits at their size; else float32 in [0, 1].
        """

    def close(self) -> None:
        """Do nothing: no file stays open between reads."""


class ImageClip:
    """Image files in the given order, 8 or 16 bit, the first of which has the number ``first``.

    Raises SourceError when a file is missing or the first one is not an image.
    """

    def __init__(self, files: Sequence[Path], first: int = 0) -> None:
        self._files, self._first = tuple(files), first
        if missing := [path for path in files if not path.is_file()]:
            raise FilesMissing(
                f"{missing[0]}: the picture is missing ({len(missing)} of {len(files)} of this camera are); restore it"
            )
        self._size, self._deep = _opened(self._files[0])

    @property
    def files(self) -> tuple[Path, ...]:
        """In order."""
        return self._files

    @property
    def where(self) -> str:
        return str(self._files[0].parent)

    @property
    def size(self) -> tuple[int, int]:
        return self._size

    @property
    def num_frames(self) -> int:
        return len(self._files)

    @property
    def first(self) -> int:
        return self._first

    @property
    def deep(self) -> bool:
        return self._deep

    def read(self, index: int, target: tuple[int, int]) -> Any:
        return read_stored(self._files[index], self._size, target, "the first image of its camera has")

    def close(self) -> None:
        """Do nothing: no file stays open between reads."""


def _opened(path: Path) -> tuple[tuple[int, int], bool]:
    """(width, height) of a picture, and whether it is deep."""
    try:
        with Image.open(path, formats=PICTURE_FORMATS) as image:
            return image.size, is_deep(path)
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError) as error:
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


def images_in(folder: Path) -> list[Path]:
    """Return the image files of a folder, in natural order; empty when there is no such folder."""
    if not folder.is_dir():
        return []
    return sorted((p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES), key=natural_sort_key)


def folder_clip(folder: Path) -> ImageClip:
    """Return all images of a folder as one camera's frames; the last number in a name is the frame number.

    Raises SourceError for an empty folder, for gaps in the numbers and for two files of one number.
    """
    files = images_in(folder)
    if not files:
        raise SourceError(f"{folder}: no images; expected frames as PNG or JPEG files")
    numbers = [_number(path) for path in files]
    if len(files) == 1:
        return ImageClip(files, numbers[0] or 0)
    known = [number for number in numbers if number is not None]
    if len(known) < len(files):
        odd = files[numbers.index(None)]
        raise SourceError(f"{odd}: expected a frame number at the end of the name, e.g. 000012.png")
    for path, number, following in zip(files[1:], known, known[1:], strict=False):
        if following != number + 1:
            what = "is there twice" if following == number else f"{number + 1} is missing"
            raise SourceError(
                f"{folder}: frame {what} (before {path.name}); a gap shifts this camera against the others: "
                "restore the file, or number the frames without gaps"
            )
    return ImageClip(files, known[0])


def _number(path: Path) -> int | None:
    found = re.findall(r"\d+", path.stem)
    return int(found[-1]) if found else None
