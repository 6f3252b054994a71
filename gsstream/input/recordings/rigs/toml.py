"""TOML of Anipose, of Pose2Sim and of Caliscope: one table per camera.

``size``, ``matrix`` (pixels, origin at the centre of the first pixel), ``distortions`` (OpenCV's order, four with
``fisheye``), ``rotation`` (a vector, or 3 x 3) and ``translation``: world to camera, OpenCV axes, units of the
board. The camera has the name in ``name``, else ``cam_ID`` of Caliscope's ``cam_id`` or
``port``, else the name of its table.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from gsstream.core.errors import SourceError
from gsstream.input.recordings.foreign import Keys, check_keys, matrix, number, pixels, reading
from gsstream.input.recordings.poses import from_pixel_centers, from_rotation_vector
from gsstream.input.recordings.rigs.camera import RigCamera, opencv_lens

SUFFIXES = (".toml",)
#: Keys of a camera that Anipose, Pose2Sim and Caliscope write.
_KEYS = Keys(
    read="name cam_id port ignore size matrix distortions fisheye rotation translation",
    idle="rotation_count exposure error grid_count verified_resolutions",
    refused="extra_distortions skew distortion_model model convention",
)


def read(path: Path, text: str) -> list[RigCamera]:
    """Return the cameras of a file; none when it describes no rig."""
    with reading(path, "valid TOML"):
        data = tomllib.loads(text)
    tables = {**data, **(data["cameras"] if isinstance(data.get("cameras"), dict) else {})}
    rig = {
        key: table
        for key, table in tables.items()
        if isinstance(table, dict) and {"matrix", "size"} <= set(table) and not table.get("ignore", False)
    }
    if rig:
        check_keys(str(path), rig.values(), _KEYS)
    return [_camera(f"{path}: {key}", key, table) for key, table in rig.items()]


def _camera(where: str, key: str, table: dict[str, Any]) -> RigCamera:
    numbered = table.get("cam_id", table.get("port"))
    name = str(table.get("name", key if numbered is None else f"cam_{numbered}"))
    size = table["size"]
    if not isinstance(size, list) or len(size) != 2:
        raise SourceError(f"{where}: size must be width and height, got {size!r:.60}")
    # Caliscope writes the text "null" for what is not known.
    coefficients = table.get("distortions", ())
    if not isinstance(coefficients, list | tuple):
        raise SourceError(f"{where}: distortions must be a list of numbers, got {coefficients!r:.60}")
    fisheye = table.get("fisheye", False)
    if not isinstance(fisheye, bool):
        raise SourceError(f"{where}: fisheye must be true or false, got {fisheye!r:.60}")
    values = [number(where, "distortions: every element", value) for value in coefficients]
    w2c = None
    if all(table.get(key, "null") != "null" for key in ("rotation", "translation")):
        rotation = matrix(where, "rotation", table["rotation"], (3,), (3, 3))
        w2c = np.eye(4)
        w2c[:3, :3] = from_rotation_vector(rotation) if rotation.shape == (3,) else rotation
        w2c[:3, 3] = matrix(where, "translation", table["translation"], (3,))
    return RigCamera(
        name=name,
        w2c=w2c,
        K=from_pixel_centers(matrix(where, "matrix", table["matrix"], (3, 3))),
        lens=opencv_lens(values, fisheye, where),
        size=(pixels(where, "size", size[0]), pixels(where, "size", size[1])),
    )
