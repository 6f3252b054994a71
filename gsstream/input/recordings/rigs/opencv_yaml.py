"""OpenCV's file storage (``*.yml``, ``*.yaml``), a file per camera, called as it.

``camera_matrix`` (or ``K``) in pixels with the origin at the centre of the first pixel, ``distortion_coefficients`` (or
``D``), and the pose, world to camera with OpenCV axes: ``R`` 3 x 3 or a vector (or ``rvec``), ``T`` (or ``tvec``).
``image_width`` and ``image_height``. ``model`` may say that it is a fisheye.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gsstream.core.errors import SourceError
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.poses import from_pixel_centers, from_rotation_vector
from gsstream.input.recordings.rigs.camera import RigCamera, opencv_lens
from gsstream.input.recordings.storage import load_storage

SUFFIXES = (".yml", ".yaml")


def read(path: Path, text: str) -> list[RigCamera]:
    """Return the camera of a file; none when it holds something else."""
    if "!!opencv-matrix" not in text or not ("camera_matrix" in text or "\nK:" in text):
        return []
    data = load_storage(path)
    K = _numbers(path, data, ("camera_matrix", "K"))
    rotation, translation = _numbers(path, data, ("R", "rvec", "Rot")), _numbers(path, data, ("T", "tvec"))
    if len(K) != 9 or len(rotation) not in (3, 9) or len(translation) != 3:
        got = f"{len(K)}, {len(rotation)}, {len(translation)}"
        raise SourceError(f"{path}: expected 9 numbers of K, 3 or 9 of R, 3 of T, got {got}; calibrate the rig, too")
    w2c = np.eye(4)
    w2c[:3, :3] = from_rotation_vector(rotation) if len(rotation) == 3 else rotation.reshape(3, 3)
    w2c[:3, 3] = translation
    coefficients = _numbers(path, data, ("distortion_coefficients", "distortion", "D", "dist"))
    fisheye = "fisheye" in str(data.get("model", "")).lower()
    lens = opencv_lens(coefficients.tolist(), fisheye, str(path))
    sides = [str(data.get(key, "")) for key in ("image_width", "image_height")]
    if not all(side.isdigit() for side in sides):
        raise SourceError(f"{path}: expected image_width and image_height in pixels, got {sides}")
    return [RigCamera(path.stem, w2c, from_pixel_centers(K.reshape(3, 3)), lens, (int(sides[0]), int(sides[1])))]


def _numbers(path: Path, data: dict[str, Any], keys: tuple[str, ...]) -> FloatArray:
    """The matrix under the first of some keys that is there, flat; empty where none is."""
    entry: Any = next((data[key] for key in keys if key in data), {})
    values = entry.get("data", ()) if isinstance(entry, dict) else entry
    try:
        return np.array([float(value) for value in values], np.float64)
    except (TypeError, ValueError) as error:
        raise SourceError(f"{path}: {' or '.join(keys)} holds something that is not a number ({error})") from error
