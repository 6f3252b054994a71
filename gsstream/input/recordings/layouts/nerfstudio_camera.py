"""A camera of nerfstudio's transforms.json: pose, intrinsics and lens, by the keys of an entry or of the whole file."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Literal

import numpy as np

from gsstream.core.errors import SourceError
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.foreign import matrix, number, pixels
from gsstream.input.recordings.lens import Lens
from gsstream.input.recordings.poses import from_opengl
from gsstream.input.recordings.rigs.camera import RigCamera

_BROWN = ("p1", "p2")
#: Model -> its kind, its radial coefficients, its tangential ones.
_MODELS: dict[str, tuple[Literal["radial", "fisheye"], tuple[str, ...], tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": ("radial", (), ()),
    "PINHOLE": ("radial", (), ()),
    "SIMPLE_RADIAL": ("radial", ("k1",), ()),
    "RADIAL": ("radial", ("k1", "k2"), ()),
    "OPENCV": ("radial", ("k1", "k2", "k3"), _BROWN),
    "FULL_OPENCV": ("radial", ("k1", "k2", "k3", "k4", "k5", "k6"), _BROWN),
    "SIMPLE_FISHEYE": ("fisheye", (), ()),
    "SIMPLE_RADIAL_FISHEYE": ("fisheye", ("k1",), ()),
    "RADIAL_FISHEYE": ("fisheye", ("k1", "k2"), ()),
    "OPENCV_FISHEYE": ("fisheye", ("k1", "k2", "k3", "k4"), ()),
}
#: Keys of a lens.
COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


def pose_of(path: Path, entry: dict[str, Any]) -> FloatArray:
    """Return camera to world [4, 4] of an entry; some programs leave out the last row. Raises SourceError."""
    key = f"transform_matrix of {entry['file_path']!r}"
    return np.concatenate([matrix(str(path), key, entry["transform_matrix"], (4, 4), (3, 4)), [[0, 0, 0, 1.0]]])[:4]


def camera_of(path: Path, data: dict[str, Any], name: str, pictures: tuple[int, int]) -> RigCamera:
    """Return a camera by the keys of its entry, or of the file; ``pictures``: (width, height) of its pictures.

    Raises SourceError that names file, key and camera.
    """
    where = str(path)
    size = tuple(
        pixels(where, f"{key} of camera {name!r}", data[key]) if key in data else side
        for key, side in zip("wh", pictures, strict=True)
    )
    focal = {axis: _focal(where, data, axis=axis, side=side, name=name) for axis, side in zip("xy", size, strict=True)}
    fx, fy = focal["x"] or focal["y"], focal["y"] or focal["x"]
    if fx is None or fy is None:
        raise SourceError(f"{path}: camera {name!r} has neither fl_x nor camera_angle_x")
    cx, cy = (
        number(where, f"c{axis} of camera {name!r}", data[f"c{axis}"]) if f"c{axis}" in data else side / 2
        for axis, side in zip("xy", size, strict=True)
    )
    return RigCamera(
        name=name,
        w2c=from_opengl(pose_of(path, data)),
        K=np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]),
        lens=_lens(where, data, name),
        size=(size[0], size[1]),
        border=False,
    )


def _focal(where: str, data: dict[str, Any], *, axis: str, side: int, name: str) -> float | None:
    """Focal length in pixels of one axis, of the first key that is there."""
    if (key := f"fl_{axis}") in data:
        return number(where, f"{key} of camera {name!r}", data[key], above=0)
    for key, full in ((f"camera_angle_{axis}", math.pi), (f"{axis}_fov", 180.0)):
        if key in data:
            message = f"an angle between 0 and {full:.5g}"
            angle = number(where, f"{key} of camera {name!r}", data[key], above=0, below=full, expected=message)
            return 0.5 * side / math.tan(0.5 * math.pi * angle / full)
    return None


def _lens(where: str, data: dict[str, Any], name: str) -> Lens:
    fisheye, model = data.get("is_fisheye"), data.get("camera_model")
    if not isinstance(fisheye, bool | None):
        raise SourceError(f"{where}: is_fisheye must be true or false, got {fisheye!r:.60}")
    model = model or ("OPENCV_FISHEYE" if fisheye else "OPENCV")
    if model not in _MODELS:
        known = ", ".join(_MODELS)
        raise SourceError(
            f"{where}: camera_model {model!r} of camera {name!r} is not supported; expected one of {known}"
        )
    kind, radial, tangential = _MODELS[model]
    if fisheye is not None and fisheye != (kind == "fisheye"):
        raise SourceError(f"{where}: camera_model {model} of camera {name!r} contradicts is_fisheye {fisheye}")
    values = {k: number(where, f"{k} of camera {name!r}", data[k]) for k in COEFFICIENTS if k in data}
    if lost := next((k for k, value in values.items() if value and k not in (*radial, *tangential)), None):
        hint = (
            "; is it an OPENCV_FISHEYE?"
            if lost == "k4"
            else f", which has {', '.join((*radial, *tangential)) or 'none'}"
        )
        raise SourceError(f"{where}: {lost} = {values[lost]:g} of camera {name!r} with camera_model {model}{hint}")
    p1, p2 = values.get("p1", 0.0), values.get("p2", 0.0)
    return Lens(kind, tuple(values.get(key, 0.0) for key in radial), (p1, p2))
