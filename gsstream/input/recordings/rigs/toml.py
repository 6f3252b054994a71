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
from gsstream.input.recordings.poses import from_pixel_centers, from_rotation_vector
from gsstream.input.recordings.rigs.camera import RigCamera, opencv_lens

SUFFIXES = (".toml",)


def read(path: Path, text: str) -> list[RigCamera]:
    """Return the cameras of a file; none when it describes no rig."""
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SourceError(f"{path}: not valid TOML: {error}") from error
    tables = {**data, **(data["cameras"] if isinstance(data.get("cameras"), dict) else {})}
    return [
        _camera(f"{path}: {key}", key, table)
        for key, table in tables.items()
        if isinstance(table, dict) and {"matrix", "size"} <= set(table) and not table.get("ignore", False)
    ]


def _camera(where: str, key: str, table: dict[str, Any]) -> RigCamera:
    number = table.get("cam_id", table.get("port"))
    name = str(table.get("name", key if number is None else f"cam_{number}"))
    try:
        matrix, size = np.array(table["matrix"], np.float64), tuple(int(side) for side in table["size"])
        rotation, translation = (np.array(table[key], np.float64) for key in ("rotation", "translation"))
        coefficients = [float(value) for value in table.get("distortions", ())]
        w2c = np.eye(4)
        w2c[:3, :3] = from_rotation_vector(rotation) if rotation.shape == (3,) else rotation
        w2c[:3, 3] = translation
    except KeyError as error:
        raise SourceError(f"{where}: no {error}: only its lens is calibrated; calibrate the rig, too") from error
    except (TypeError, ValueError) as error:
        raise SourceError(f"{where}: expected numbers in matrix, size, rotation and translation ({error})") from error
    if matrix.shape != (3, 3) or len(size) != 2:
        raise SourceError(f"{where}: expected matrix 3 x 3 and size (width, height), got {list(matrix.shape)}, {size}")
    lens = opencv_lens(coefficients, bool(table.get("fisheye", False)), where)
    return RigCamera(name=name, w2c=w2c, K=from_pixel_centers(matrix), lens=lens, size=(size[0], size[1]))
