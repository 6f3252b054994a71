"""COLMAP's sparse model as data: cameras, images, points3D, each as .bin or .txt. Own reader, so that nothing native
is loaded to read a few tables; checked against pycolmap's writer in the tests.

Quaternions wxyz and translations are world to camera with OpenCV axes; pixels have their origin at the image corner.
World units are arbitrary.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsstream.core.errors import SourceError
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.foreign import MAX_SIDE, reading

#: Number in .bin files -> name and number of parameters.
MODELS = {
    0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5), 4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8), 6: ("FULL_OPENCV", 12), 7: ("FOV", 5), 8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5), 10: ("THIN_PRISM_FISHEYE", 12), 11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4), 13: ("DIVISION", 5), 14: ("SIMPLE_FISHEYE", 3), 15: ("FISHEYE", 4), 16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}  # fmt: skip
_POINT = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
_TRACK = np.dtype([("image", "<i4"), ("point", "<i4")])


@dataclass(frozen=True, slots=True)
class ModelCamera:
    """Intrinsics: COLMAP's model name, size in pixels, parameters in COLMAP's order."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class ModelImage:
    """A registered image: quaternion [4] wxyz and translation [3], world to camera."""

    name: str
    camera: int
    quaternion: FloatArray
    translation: FloatArray


@dataclass(frozen=True, slots=True)
class ModelPoints:
    """[P, 3] positions, [P, 3] uint8 colours and, per point, the numbers of the images that saw it."""

    xyz: FloatArray
    rgb: np.ndarray[Any, np.dtype[np.uint8]]
    seen_by: list[np.ndarray[Any, Any]]


class _Bytes:
    """A binary file read front to back; every length is checked against what is left."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.at = path, path.read_bytes(), 0

    def take(self, layout: str) -> tuple[Any, ...]:
        size = struct.calcsize(layout)
        values = struct.unpack_from(layout, self.data, self._reserve(size))
        return values

    def count(self, least: int) -> int:
        """A 64-bit count of entries of at least ``least`` bytes each."""
        (number,) = self.take("<Q")
        if number * least > len(self.data) - self.at:
            raise SourceError(f"{self.path}: byte {self.at - 8} announces {number} entries, more than the file holds")
        return int(number)

    def array(self, dtype: np.dtype[Any], number: int) -> np.ndarray[Any, Any]:
        return np.frombuffer(self.data, dtype, number, self._reserve(number * dtype.itemsize))

    def text(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise SourceError(f"{self.path}: a name without an end at byte {self.at}; the file is cut")
        name = self.data[self.at : end].decode("utf-8", "replace")
        self.at = end + 1
        return name

    def _reserve(self, size: int) -> int:
        start = self.at
        if size > len(self.data) - start:
            raise SourceError(f"{self.path}: cut short at byte {len(self.data)}; copy or export the model again")
        self.at += size
        return start


def read_cameras(folder: Path) -> dict[int, ModelCamera]:
    """Return camera number -> intrinsics. Raises SourceError for an unknown model, a cut or unreadable file."""
    path = _file(folder, "cameras")
    cameras: dict[int, ModelCamera] = {}
    if path.suffix == ".bin":
        file = _Bytes(path)
        for _ in range(file.count(24)):
            number, model, width, height = file.take("<iiQQ")
            if model not in MODELS:
                raise SourceError(f"{path}: camera {number} has the unknown model number {model}")
            name, size = MODELS[model]
            with reading(f"{path}:{number}", "a line of this file"):
                cameras[number] = _camera(name, width, height, file.take(f"<{size}d"))
        return cameras
    sizes = dict(MODELS.values())
    for where, words in _lines(path):
        with reading(f"{path}:{where}", "a line of this file"):
            number, name, width, height = int(words[0]), words[1], int(words[2]), int(words[3])
            params = tuple(float(word) for word in words[4:])
            if sizes.get(name) != len(params):
                raise ValueError(f"model {name} with {len(params)} parameters")
            cameras[number] = _camera(name, width, height, params)
    return cameras


def _camera(model: str, width: int, height: int, params: tuple[float, ...]) -> ModelCamera:
    if not np.isfinite(params).all() or not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise ValueError(f"a camera of {width} x {height} pixels with the parameters {params}")
    return ModelCamera(model, width, height, params)


def read_images(folder: Path) -> dict[int, ModelImage]:
    """Return image number -> registered image."""
    path = _file(folder, "images")
    images: dict[int, ModelImage] = {}
    if path.suffix == ".bin":
        file = _Bytes(path)
        for _ in range(file.count(73)):
            number, *pose, camera = file.take("<i7di")
            name = file.text()
            file.array(_POINT, file.count(_POINT.itemsize))
            images[number] = ModelImage(name, camera, np.array(pose[:4]), np.array(pose[4:]))
        return images
    # Two lines per image, of which the second, its points, may be empty; written by hand, it may be left out.
    after_pose = False
    for where, line in enumerate(_text(path).split("\n"), 1):
        if line.startswith("#") or not line.strip():
            after_pose = after_pose and line.startswith("#")
            continue
        if after_pose and _is_points(line.split()):
            after_pose = False
            continue
        words = line.split(maxsplit=9)
        after_pose = True
        with reading(f"{path}:{where}", "a line of this file"):
            pose = [float(word) for word in words[1:8]]
            image = ModelImage(words[9].strip(), int(words[8]), np.array(pose[:4]), np.array(pose[4:]))
            if int(words[0]) in images:
                raise ValueError(f"image {words[0]} is there twice")
            if not np.isfinite(pose).all():
                raise ValueError("the pose is not finite")
            images[int(words[0])] = image
    return images


def _is_points(words: list[str]) -> bool:
    """Whether a line holds the points of an image: triples of numbers, the last of each whole."""
    try:
        return len(words) % 3 == 0 and bool([[float(word) for word in words], [int(word) for word in words[2::3]]])
    except ValueError:
        return False


def read_points(folder: Path) -> ModelPoints:
    """Return all points of the model."""
    path = _file(folder, "points3D")
    xyz: list[Any] = []
    rgb: list[Any] = []
    seen: list[np.ndarray[Any, Any]] = []
    if path.suffix == ".bin":
        file = _Bytes(path)
        for _ in range(file.count(51)):
            values = file.take("<Q3d3Bd")
            xyz.append(values[1:4])
            rgb.append(values[4:7])
            seen.append(file.array(_TRACK, file.count(_TRACK.itemsize))["image"])
    else:
        for where, words in _lines(path):
            with reading(f"{path}:{where}", "a line of this file"):
                xyz.append([float(word) for word in words[1:4]])
                rgb.append([int(word) for word in words[4:7]])
                seen.append(np.array([int(word) for word in words[8::2]], np.int64))
                if len(xyz[-1]) != 3 or len(rgb[-1]) != 3 or not all(0 <= c <= 255 for c in rgb[-1]):
                    raise ValueError("expected three coordinates and three colours from 0 to 255")
    positions = np.array(xyz, np.float64).reshape(-1, 3)
    if not np.isfinite(positions).all():
        raise SourceError(f"{path}: {int((~np.isfinite(positions)).any(1).sum())} points are not finite")
    return ModelPoints(positions, np.array(rgb, np.uint8).reshape(-1, 3), seen)


def has_model(folder: Path) -> bool:
    """Say whether cameras and images lie here."""
    return all(any((folder / f"{name}{end}").is_file() for end in (".bin", ".txt")) for name in ("cameras", "images"))


def has_points(folder: Path) -> bool:
    """Say whether points lie here, too."""
    return any((folder / f"points3D{end}").is_file() for end in (".bin", ".txt"))


def _file(folder: Path, name: str) -> Path:
    for end in (".bin", ".txt"):
        if (path := folder / f"{name}{end}").is_file():
            return path
    raise SourceError(f"{folder}: no {name}.bin and no {name}.txt; expected a COLMAP model")


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"{path}: cannot be read: {error}") from error


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    for where, line in enumerate(_text(path).split("\n"), 1):
        if line.strip() and not line.startswith("#"):
            yield where, line.split()
