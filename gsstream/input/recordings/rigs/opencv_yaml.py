"""OpenCV's file storage (``*.yml``, ``*.yaml``), a file per camera, called as it.

``camera_matrix`` (or ``K``) in pixels with the origin at the centre of the first pixel, ``distortion_coefficients`` (or
``D``), and the pose, world to camera with OpenCV axes: ``R`` 3 x 3 or a vector (or ``rvec``), ``T`` (or ``tvec``).
``image_width`` and ``image_height``. ``model`` may say that it is a fisheye.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.nodes import MappingNode, ScalarNode, SequenceNode

from gsstream.core.errors import SourceError
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.poses import from_pixel_centers, from_rotation_vector
from gsstream.input.recordings.rigs.camera import RigCamera, opencv_lens

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
    return [
        RigCamera(
            name=path.stem,
            w2c=w2c,
            K=from_pixel_centers(K.reshape(3, 3)),
            lens=lens,
            size=(int(sides[0]), int(sides[1])),
        )
    ]


def _numbers(path: Path, data: dict[str, Any], keys: tuple[str, ...]) -> FloatArray:
    """The matrix under the first of some keys that is there, flat; empty where none is."""
    entry: Any = next((data[key] for key in keys if key in data), {})
    values = entry.get("data", ()) if isinstance(entry, dict) else entry
    try:
        return np.array([float(value) for value in values], np.float64)
    except (TypeError, ValueError) as error:
        raise SourceError(f"{path}: {' or '.join(keys)} holds something that is not a number ({error})") from error


def load_storage(path: Path) -> dict[str, Any]:
    """Read a file: a first line that YAML does not know, and matrices under a tag of their own.

    Raises SourceError for what cannot be read.
    """
    try:
        text = path.read_text(encoding="utf-8")
        # "%YAML:1.0" is no YAML directive; "- 00" in a list of names must stay a text.
        body = "\n".join(line for line in text.splitlines() if not line.startswith("%YAML"))
        node = YAML(typ="safe", pure=True).compose(body)
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"{path}: cannot be read: {error}") from error
    except YAMLError as error:
        place = str(error).splitlines()
        raise SourceError(f"{path}: not valid YAML: {place[0] if place else error}") from error
    if not isinstance(node, MappingNode):
        raise SourceError(f"{path}: expected keys with values")
    return {str(key.value): _plain(value) for key, value in node.value}


def _plain(node: Any) -> Any:
    """Texts stay texts: "00" is a name, and numbers are read where a matrix is wanted."""
    if isinstance(node, MappingNode):
        return {str(key.value): _plain(value) for key, value in node.value}
    if isinstance(node, SequenceNode):
        return [_plain(item) for item in node.value]
    return node.value if isinstance(node, ScalarNode) else None
