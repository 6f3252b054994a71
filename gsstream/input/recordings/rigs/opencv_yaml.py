"""OpenCV's file storage (``*.yml``, ``*.yaml``), a file per camera, called as it.

``camera_matrix`` (or ``K``) in pixels with the origin at the centre of the first pixel, ``distortion_coefficients`` (or
``D``), and the pose, world to camera with OpenCV axes: ``R`` 3 x 3 or a vector (or ``rvec``), ``T`` (or ``tvec``).
``image_width`` and ``image_height``. ``model`` may say that it is a fisheye.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError
from ruamel.yaml.nodes import MappingNode, ScalarNode, SequenceNode

from gsstream.core.errors import SourceError
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.foreign import Keys, check_keys, parsed, pixels
from gsstream.input.recordings.poses import from_pixel_centers, from_rotation_vector
from gsstream.input.recordings.rigs.camera import RigCamera, opencv_lens

SUFFIXES = (".yml", ".yaml")


#: Keys that OpenCV's samples, MC-Calib and the tools of ROS write.
_KEYS = Keys(
    read="""
        camera_matrix K R rvec Rot T tvec distortion_coefficients distortion D dist image_width image_height
        model distortion_model
    """,
    idle="""
        calibration_time nframes nr_of_frames board_width board_height square_size flags image_list image_points
        grid_points extrinsic_parameters avg_reprojection_error per_view_* camera_name F P rectification_matrix
        projection_matrix aspectRatio names
    """,
    refused="xi skew distortion_type camera_group lens_model",
)
_FISHEYE, _BROWN = (
    ("fisheye", "equidistant", "opencv_fisheye"),
    ("", "plumb_bob", "rational_polynomial", "pinhole", "opencv"),
)


def read(path: Path, text: str) -> list[RigCamera]:
    """Return the camera of a file; none when it holds something else."""
    if "!!opencv-matrix" not in text or not ("camera_matrix" in text or "\nK:" in text):
        return []
    data, where = load_storage(path), str(path)
    check_keys(where, [data], _KEYS)
    rotation, translation = (
        numbers_of(where, data, "R", "rvec", "Rot", counts=(3, 9)),
        numbers_of(where, data, "T", "tvec", counts=(3,)),
    )
    w2c = None
    if len(rotation) and len(translation):
        w2c = np.eye(4)
        w2c[:3, :3] = from_rotation_vector(rotation) if len(rotation) == 3 else rotation.reshape(3, 3)
        w2c[:3, 3] = translation
    coefficients = numbers_of(where, data, "distortion_coefficients", "distortion", "D", "dist")
    model = str(data.get("model", data.get("distortion_model", ""))).lower()
    if model not in (*_FISHEYE, *_BROWN):
        raise SourceError(
            f"{path}: the model {model!r} is not supported; expected one of {', '.join((*_BROWN[1:], *_FISHEYE))}"
        )
    lens = opencv_lens(coefficients.tolist(), model in _FISHEYE, where)
    sides = [str(data.get(key, "")) for key in ("image_width", "image_height")]
    if not all(side.isdigit() for side in sides):
        raise SourceError(f"{path}: expected image_width and image_height in pixels, got {sides}")
    size = pixels(where, "image_width", int(sides[0])), pixels(where, "image_height", int(sides[1]))
    K = numbers_of(where, data, "camera_matrix", "K", counts=(9,)).reshape(3, 3)
    return [RigCamera(name=path.stem, w2c=w2c, K=from_pixel_centers(K), lens=lens, size=size)]


def numbers_of(where: str, data: dict[str, Any], *keys: str, counts: tuple[int, ...] = ()) -> FloatArray:
    """Return the matrix under the first of some keys that is there, flat; empty where none is.

    Raises SourceError for what is no number, and for as many as none of ``counts``.
    """
    key = next((key for key in keys if key in data), None)
    if key is None:
        return np.zeros(0)
    values = data[key].get("data", ()) if isinstance(data[key], dict) else data[key]
    return parsed(where, key, values if isinstance(values, list) else [values], *counts)


def load_storage(path: Path) -> dict[str, Any]:
    """Read a file: a first line that YAML does not know, and matrices under a tag of their own.

    Raises SourceError for what cannot be read.
    """
    try:
        text = path.read_text(encoding="utf-8")
        # "%YAML:1.0" is no YAML directive; "- 00" in a list of names must stay a text.
        body = "\n".join(line for line in text.splitlines() if not line.startswith("%YAML"))
        node = _composed(body)
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"{path}: cannot be read: {error}") from error
    except YAMLError as error:
        place = str(error).splitlines()
        raise SourceError(f"{path}: not valid YAML: {place[0] if place else error}") from error
    if not isinstance(node, MappingNode):
        raise SourceError(f"{path}: expected keys with values")
    return {str(key.value): _plain(value) for key, value in node.value}


@lru_cache(maxsize=8)
def _composed(body: str) -> Any:
    """The node of a text. A tenth of a second for four cameras, and what opens a recording opens it several times."""
    return YAML(typ="safe", pure=True).compose(body)


def _plain(node: Any) -> Any:
    """Texts stay texts: "00" is a name, and numbers are read where a matrix is wanted."""
    if isinstance(node, MappingNode):
        return {str(key.value): _plain(value) for key, value in node.value}
    if isinstance(node, SequenceNode):
        return [_plain(item) for item in node.value]
    return node.value if isinstance(node, ScalarNode) else None
