"""What a method left that was trained elsewhere: a folder of 3DGS PLYs, or of pictures, seen by the same cameras."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gsstream.core.errors import InputError
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import BoolArray, FloatArray
from gsstream.evaluation.seen import seen_masks
from gsstream.input.recordings.base import SourceInfo
from gsstream.input.recordings.clips import IMAGE_SUFFIXES, files_in
from gsstream.input.recordings.images import PICTURE_FORMATS, UNDECODABLE
from gsstream.player.ply import read_ply
from gsstream.player.render import find_renderer, render


def numbered(folder: Path, suffixes: Sequence[str], first: int) -> dict[int, Path]:
    """Return frame -> file of a folder; the last number in a file's name counts.

    Raises InputError when there is no such file, and for a name without a number, one below ``first`` and one twice.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is no folder; expected one with files such as 000000{suffixes[0]}")
    found: dict[int, Path] = {}
    for path in files_in(folder, suffixes):
        digits = re.findall(r"\d+", path.stem)
        if not digits or int(digits[-1]) < first:
            raise InputError(f"{path}: expected a name that ends with a number from {first} on, which is its frame")
        frame = int(digits[-1]) - first
        if frame in found:
            raise InputError(f"{path} and {found[frame].name} are both frame {frame}; leave one of them")
        found[frame] = path
    if not found:
        raise InputError(f"{folder} holds no file that ends with {' or '.join(suffixes)}")
    return dict(sorted(found.items()))


class PlySequence:
    """A folder of 3DGS PLYs, one per frame, in the coordinates of the recording."""

    def __init__(self, folder: Path, info: SourceInfo, first: int, background: tuple[float, float, float]) -> None:
        self._files, self._info = numbered(folder, (".ply",), first), info
        self._backgrounds = _backgrounds(folder, background)
        self._with = find_renderer()
        self._last: tuple[int, Gaussians[FloatArray]] | None = None
        self.rig, self.renderer, self.frames = info.test, self._with.name, _in_recording(self._files, info)

    def file(self, frame: int) -> Path:
        """Return the file of a frame."""
        return self._files[frame]

    def images(self, frame: int) -> list[FloatArray]:
        """Return what the test cameras see of a frame."""
        scene, views = self._scene(frame), range(len(self.rig))
        behind = self._backgrounds.get(self._files[frame].name, self._backgrounds[""])
        return [np.clip(render(scene, self.rig, view, background=behind, renderer=self._with), 0, 1) for view in views]

    def seen(self, frame: int) -> list[BoolArray]:
        """Return the pixels of the test cameras whose surface the recording's training cameras see."""
        return seen_masks(self._scene(frame), self._info.train, self.rig, self._with)

    def _scene(self, frame: int) -> Gaussians[FloatArray]:
        """The scene of a frame; that of the last one that was asked for is not read again."""
        if self._last is None or self._last[0] != frame:
            self._last = frame, self._read(frame)
        return self._last[1]

    def _read(self, frame: int) -> Gaussians[FloatArray]:
        scene, offset = read_ply(self._files[frame])
        # In float64 until it is in the stream's coordinates: the recording's origin may be far away.
        world = self._info.world
        moved = tuple(np.array(world.offset) - np.array(offset))
        return replace(world, offset=moved).inverse().gaussians(scene).map(lambda value: value.astype(np.float32))


class Renders:
    """A folder of pictures: a folder for each test camera, with a picture per frame; for one camera also without it."""

    renderer = "elsewhere"

    def __init__(self, folder: Path, info: SourceInfo, first: int) -> None:
        self.rig = info.test
        folders = {name: folder / name for name in info.test.ids}
        missing = [name for name, path in folders.items() if not path.is_dir()]
        if missing and not (len(folders) == 1 and folder.is_dir()):
            raise InputError(
                f"{folder}: expected a folder for each test camera, {', '.join(info.test.ids)}; missing: "
                f"{', '.join(missing)}"
            )
        self._files = {
            name: numbered(folder if name in missing else path, IMAGE_SUFFIXES, first) for name, path in folders.items()
        }
        one, *others = self._files.values()
        if any(set(other) != set(one) for other in others):
            raise InputError(f"{folder}: expected pictures of the same frames from every camera")
        self.frames = _in_recording(one, info)

    def file(self, frame: int) -> None:
        """Return None: pictures are not what a method sends."""

    def images(self, frame: int) -> list[FloatArray]:
        """Return the pictures of a frame. Raises InputError for one of another size."""
        return [self._image(self._files[name][frame]) for name in self.rig.ids]

    def seen(self, frame: int) -> None:
        """Return None: pictures do not say where the surfaces in them are."""

    def _image(self, path: Path) -> FloatArray:
        try:
            with Image.open(path, formats=PICTURE_FORMATS) as file:
                if file.size != (self.rig.width, self.rig.height):
                    raise InputError(
                        f"{path}: expected {self.rig.width} x {self.rig.height} pixels as the recording has at this "
                        f"--scale, got {file.width} x {file.height}"
                    )
                return np.asarray(file.convert("RGB"), np.float32) / 255
        except InputError:  # is a ValueError, too
            raise
        except UNDECODABLE as error:
            raise InputError(f"{path} cannot be read as a picture: {error}") from error


def bytes_line(files: Sequence[Path], frames: int) -> str:
    """Return the sentence that says what files take; empty without any.

    Raises InputError for a path that does not exist.
    """
    every = []
    for path in files:
        if not path.exists():
            raise InputError(f"--files {path}: there is no such file or folder")
        every += [path] if path.is_file() else [below for below in path.rglob("*") if below.is_file()]
    if not every:
        return ""
    kilobytes = sum(path.stat().st_size for path in every) / 1000
    return f"{len(every)} files, {kilobytes:.1f} KB; {kilobytes / frames:.1f} KB/frame over {frames} frames"


def _in_recording(files: dict[int, Path], info: SourceInfo) -> tuple[int, ...]:
    """The frames; raises InputError for one that the recording does not have."""
    last = max(files)
    if info.num_frames is not None and last >= info.num_frames:
        raise InputError(
            f"{files[last]} is frame {last}, but the recording has frames 0 to {info.num_frames - 1}; does --first say "
            "which number is frame 0?"
        )
    return tuple(files)


def _backgrounds(folder: Path, usual: tuple[float, float, float]) -> dict[str, tuple[float, float, float]]:
    """The background that ``sequence.json`` names, which ``gsstream export`` writes, else the usual one, as that of "".

    Those of files that have another one, where a lamp was switched, are told by the names of the files.
    """
    path = folder / "sequence.json"
    if not path.is_file():
        return {"": usual}
    try:
        said = json.loads(path.read_text(encoding="utf-8"))
        others = {
            entry["file"]: _colour(entry["background"]) for entry in said.get("frames", []) if "background" in entry
        }
        return {"": _colour(said["background"]), **others}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: expected an entry background of three numbers: {error!r}") from error


def _colour(value: list[Any]) -> tuple[float, float, float]:
    red, green, blue = (float(part) for part in value)
    return red, green, blue
