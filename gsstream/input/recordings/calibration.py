"""cameras.json, schema "opencv-multiview-1": the rig, its split, its lenses and where each camera's images lie."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.errors import InputError, ShapeError, SourceError
from gsstream.core.install_hints import page
from gsstream.core.memory import require_memory
from gsstream.core.names import check_camera_ids
from gsstream.input.recordings.base import Split
from gsstream.input.recordings.clips import VIDEO_SUFFIXES, prepare_command
from gsstream.input.recordings.foreign import MAX_NUMBER, MAX_SIDE, Keys, brief, check_keys, matrix, number
from gsstream.input.recordings.lens import Lens
from gsstream.input.recordings.rigs.camera import opencv_lens

SCHEMA = "opencv-multiview-1"
#: Largest numbers of frames and cameras, and lengths of a text and of a pattern that a file may state. They are checked
#: before any memory is allocated and any file is opened.
MAX_FRAMES, MAX_CAMERAS, MAX_TEXT, MAX_PATTERN = 10_000_000, 10_000, 1 << 20, 1000
#: Bytes of JSON that need no picture or camera, and bytes for each of those: no program writes more.
PLAIN, PER_NAME = 2_000_000, 4_000
#: Bytes of memory that each of these signs of a JSON file stands for, and most of them for every byte of a large file.
_WEIGHTS, _HEAVIEST = {b"{": 230, b'"': 25, b":": 50, b",": 8, b".": 24}, 8
_NAMES = re.compile(rb'"file_path"|"id"|\.(?:png|jpe?g)"', re.IGNORECASE)
CALIBRATION_FILE = "cameras.json"
_KEYS = Keys(
    read="schema name fps frames test_cameras licence cameras",
    idle="convention source derived_from depth dynamic_mask bounds units notes",
)
_CAMERA_KEYS = Keys(
    read="id split width height K w2c frames distortion fisheye",
    idle="colmap_name photometric gain notes",
    refused="camera_model is_fisheye dist skew k1 k2 k3 k4 k5 k6 p1 p2",
)


@dataclass(frozen=True, slots=True)
class Calibration:
    """What cameras.json says."""

    name: str
    fps: float
    num_frames: int  # 0 where a growing recording, or one of videos alone, does not say
    licence: str
    #: train, test: as declared; of the size of the first camera where sizes differ.
    train: Cameras
    test: Cameras
    #: Camera id -> path of its video, or pattern of the paths of its images, relative to the folder.
    patterns: dict[str, str]
    lenses: dict[str, Lens]  # camera id -> its distortion, where it has any
    sizes: dict[str, tuple[int, int]]  # camera id -> (width, height)


def read_calibration(folder: Path, *, growing: bool = False, any_sizes: bool = False) -> Calibration:
    """Read and check ``folder/cameras.json``.

    Raises SourceError saying which file, camera or key is wrong, and what was expected.
    """
    if not folder.is_dir():
        raise SourceError(f"{folder}: no such folder; expected a recording with {CALIBRATION_FILE} and its images")
    path = folder / CALIBRATION_FILE
    data = _load_json(path)
    cameras = data.get("cameras")
    if not isinstance(cameras, list) or not cameras or not all(isinstance(c, dict) for c in cameras):
        raise SourceError(f"{path}: 'cameras' must be a non-empty list of objects, got {brief(cameras)}")
    check_keys(str(path), [data], _KEYS)
    check_keys(f"{path}: cameras", cameras, _CAMERA_KEYS)
    ids = [_camera_id(path, camera, index) for index, camera in enumerate(cameras)]
    if len(set(ids)) != len(ids):
        twice = sorted({i for i in ids if ids.count(i) > 1})
        raise SourceError(f"{path}: camera ids must be unique, these occur more than once: {', '.join(twice)}")
    sizes = {i: _size(path, i, camera) for i, camera in zip(ids, cameras, strict=True)}
    rig = _rig(path, cameras, sizes, any_sizes)
    splits = _splits(path, ids, cameras, data.get("test_cameras"))
    train = [i for i, split in enumerate(splits) if split == "train"]
    if not train:
        raise SourceError(f'{path}: there is no training camera; give at least one camera "split": "train"')
    patterns = {i: _pattern(path, i, camera) for i, camera in zip(ids, cameras, strict=True)}
    uncounted = "frames" not in data and (growing or all(map(is_video, patterns.values())))
    lenses = {i: _lens(path, i, camera) for i, camera in zip(ids, cameras, strict=True)}
    return Calibration(
        name=_text(path, "name", data.get("name", folder.name), MAX_PATTERN),
        fps=number(
            str(path), "'fps'", data.get("fps", 30.0), above=0, below=1e6, expected="a positive number below a million"
        ),
        num_frames=0 if uncounted else _count(path, data.get("frames")),
        licence=_text(path, "licence", data.get("licence", ""), MAX_TEXT),
        train=rig.select(train),
        test=rig.select([i for i, split in enumerate(splits) if split == "test"]),
        patterns=patterns,
        lenses={i: lens for i, lens in lenses.items() if not lens.is_identity},
        sizes=sizes,
    )


def read_json(path: Path) -> dict[str, Any]:
    """Return the object of a JSON file; empty for any other value. Raises SourceError for what cannot be read."""
    data = _parse_json(path)
    return data if isinstance(data, dict) else {}


def _parse_json(path: Path, absent: str = "") -> Any:
    try:
        require_memory(_HEAVIEST * path.stat().st_size, f"reading {path}")
        data = path.read_bytes()
        _check_weight(path, data)
        return json.loads(data)
    except InputError:  # is a ValueError, too
        raise
    except (ValueError, RecursionError) as error:  # no JSON, no UTF-8, numbers of thousands of digits, deep nesting
        raise SourceError(f"{path}: not valid JSON: {error}") from error
    except OSError as error:
        message = absent if absent and isinstance(error, FileNotFoundError) else f"cannot be read: {error}"
        raise SourceError(f"{path}: {message}") from error


def _check_weight(path: Path, data: bytes) -> None:
    """Raise SourceError for a file that is larger than its pictures and cameras explain, before it is parsed."""
    if (cameras := data.count(b'"w2c"')) > MAX_CAMERAS:
        raise SourceError(f"{path}: expected at most {MAX_CAMERAS} cameras, got {cameras}")
    most = PLAIN + PER_NAME * sum(1 for _ in _NAMES.finditer(data)) if len(data) > PLAIN else PLAIN
    weight = sum(data.count(sign) * each for sign, each in _WEIGHTS.items())
    if len(data) > most or (len(data) > PLAIN / 2 and weight > _HEAVIEST * len(data)):
        raise SourceError(
            f"{path}: {len(data)} bytes of numbers and texts that no picture and no camera needs; export the "
            "calibration again"
        )


def _load_json(path: Path) -> dict[str, Any]:
    absent = f"no such file; a recording folder holds {CALIBRATION_FILE} (schema {SCHEMA!r}) beside its images"
    data = _parse_json(path, absent)
    # A file without a schema is taken for one of this: what it holds is checked key by key.
    if not isinstance(data, dict) or data.get("schema", SCHEMA) != SCHEMA or "cameras" not in data:
        raise SourceError(
            f'{path}: expected {{"schema": "{SCHEMA}", "frames": 60, "cameras": [{{"id": "cam00", "width": 1280, '
            f'"height": 720, "K": [3 x 3], "w2c": [4 x 4], "frames": "cam00.mp4"}}, ...]}}, got {_shown(data)}; '
            f"convert the calibration to it ({page('reference/scene-formats.md')})"
        )
    return data


def _shown(data: Any) -> str:
    if not isinstance(data, dict):
        return f"a {type(data).__name__}"
    return f'"schema": {brief(data["schema"])}' if "schema" in data else f"the keys {brief(sorted(data))}"


def _rig(path: Path, cameras: list[dict[str, Any]], sizes: dict[str, tuple[int, int]], any_sizes: bool) -> Cameras:
    ids = list(sizes)
    first = sizes[ids[0]]
    for camera_id, size in sizes.items():
        if size != first and not any_sizes:
            raise SourceError(
                f"{path}: all cameras of a rig must share one image size, but {ids[0]!r} is {first[0]} x {first[1]} "
                f"and {camera_id!r} is {size[0]} x {size[1]}; to bring them to one: {prepare_command(str(path.parent))}"
            )
    poses = np.stack([_matrix(path, i, c, key="w2c", side=4) for i, c in zip(ids, cameras, strict=True)])
    intrinsics = np.stack([_matrix(path, i, c, key="K", side=3) for i, c in zip(ids, cameras, strict=True)])
    rig = Cameras(tuple(ids), poses, intrinsics, *first)
    try:
        rig.validate()
    except ShapeError as error:
        raise SourceError(f"{path}: {error}") from error
    for i, camera_id in enumerate(ids):
        if not np.allclose(poses[i, 3], (0, 0, 0, 1)) or not np.allclose(intrinsics[i, 2], (0, 0, 1)):
            raise SourceError(f"{path}: camera {camera_id!r}: the last row of w2c must be 0 0 0 1 and of K 0 0 1")
    return rig


def _splits(path: Path, ids: list[str], cameras: list[dict[str, Any]], named: Any) -> list[Split]:
    if named is not None and not (isinstance(named, list) and all(isinstance(name, str) for name in named)):
        raise SourceError(f"{path}: 'test_cameras' must be a list of camera ids, got {brief(named)}")
    test = set(named or [])
    if unknown := sorted(str(t) for t in test - set(ids)):
        names = ", ".join(map(repr, unknown))
        raise SourceError(f"{path}: test camera {names} does not exist; cameras: {', '.join(ids)}")
    splits: list[Split] = []
    for camera_id, camera in zip(ids, cameras, strict=True):
        split = camera.get("split", "test" if camera_id in test else "train")
        if split not in ("train", "test"):
            raise SourceError(f'{path}: camera {camera_id!r}: split must be "train" or "test", got {split!r}')
        if named is not None and (split == "test") != (camera_id in test):
            raise SourceError(
                f"{path}: camera {camera_id!r} has split {split!r}, which contradicts 'test_cameras' {sorted(test)}"
            )
        splits.append(split)
    return splits


def _camera_id(path: Path, camera: dict[str, Any], index: int) -> str:
    camera_id = camera.get("id")
    if not isinstance(camera_id, str) or not camera_id:
        raise SourceError(f"{path}: camera number {index} needs a non-empty text 'id', got {brief(camera_id)}")
    try:
        check_camera_ids([camera_id])
    except ShapeError as error:
        raise SourceError(f"{path}: {error}") from error
    return camera_id


def _size(path: Path, camera_id: str, camera: dict[str, Any]) -> tuple[int, int]:
    width, height = camera.get("width"), camera.get("height")
    if type(width) is int and type(height) is int and 1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE:
        return width, height
    raise SourceError(
        f"{path}: camera {camera_id!r}: width and height must be positive whole pixels up to {MAX_SIDE}, got "
        f"{brief(width)} x {brief(height)}"
    )


def _matrix(path: Path, camera_id: str, camera: dict[str, Any], key: str, side: int) -> np.ndarray[Any, Any]:
    if key not in camera:
        what = "intrinsics in pixels" if key == "K" else "world to camera, OpenCV axes"
        raise SourceError(f"{path}: camera {camera_id!r} has no {key!r}; give the {side} x {side} matrix ({what})")
    return matrix(f"{path}: camera {camera_id!r}", key, camera[key], (side, side))


def _lens(path: Path, camera_id: str, camera: dict[str, Any]) -> Lens:
    values, fisheye, where = camera.get("distortion", []), camera.get("fisheye", False), f"{path}: camera {camera_id!r}"
    numbers = isinstance(values, list) and all(type(v) in (int, float) and abs(v) < MAX_NUMBER for v in values)
    if not numbers or not isinstance(fisheye, bool):
        raise SourceError(
            f"{where}: 'distortion' must be a list of numbers (k1, k2, p1, p2, k3, ... as OpenCV has them) and "
            f"'fisheye' true or false, got {brief(values)} and {brief(fisheye)}"
        )
    return opencv_lens(list(map(float, values)), fisheye, f"{where}: distortion")


def _pattern(path: Path, camera_id: str, camera: dict[str, Any]) -> str:
    pattern = camera.get("frames")
    if not isinstance(pattern, str) or not pattern:
        raise SourceError(
            f'{path}: camera {camera_id!r} has no frames; give "frames" as a path pattern such as '
            f'"{camera_id}/%06d.png", or as the path of a video'
        )
    if len(pattern) > MAX_PATTERN or re.search(r"%[^a-zA-Z]*\d{3}", pattern):
        raise SourceError(f"{path}: camera {camera_id!r}: 'frames' {brief(pattern)} is longer than a path can be")
    try:
        example = frame_path(pattern, 0)
    except (TypeError, ValueError) as error:
        raise SourceError(
            f"{path}: camera {camera_id!r}: 'frames' {pattern!r} must hold one integer conversion "
            f"such as %06d ({error})"
        ) from error
    if PurePosixPath(example).is_absolute() or ".." in PurePosixPath(example).parts:
        raise SourceError(f"{path}: camera {camera_id!r}: 'frames' {pattern!r} must stay inside the recording's folder")
    return pattern


def is_video(pattern: str) -> bool:
    """Say whether ``frames`` of a camera is the path of a video."""
    return pattern.lower().endswith(VIDEO_SUFFIXES)


def frame_path(pattern: str, index: int) -> str:
    """Return the relative path of a frame; a pattern without a conversion names the one image of a static set."""
    return pattern % index if "%" in pattern and not is_video(pattern) else pattern


def _count(path: Path, frames: Any) -> int:
    if type(frames) is not int or not 1 <= frames <= MAX_FRAMES:
        raise SourceError(
            f"{path}: 'frames' must be the number of frames, at least 1 and at most {MAX_FRAMES}, got {brief(frames)}"
        )
    return frames


def _text(path: Path, key: str, value: Any, most: int) -> str:
    """A text that streams, plots and terminals can carry; other plain values are written out."""
    text = str(value)
    if len(text) > most:
        raise SourceError(f"{path}: {key!r} is {len(text)} letters long; expected at most {most}")
    # The name of a folder may hold bytes that are not UTF-8; in a JSON text they are an error.
    if path.parent.name != text and any("\ud800" <= sign <= "\udfff" for sign in text):
        raise SourceError(f"{path}: {key!r} holds half of a character (a lone surrogate); write it as UTF-8")
    return text
