"""Qualisys Track Manager's calibration (``*.qca.txt``, ``.xml``), as Pose2Sim's recordings have it.

``camera`` by ``serial``: ``transform`` with the rotation r11 ... r33 (world to camera, OpenGL axes: y up, z back) and
the centre x, y, z in millimetres; ``intrinsic`` in 1/64 pixel, origin at the centre of the first pixel, measured from
the corner of ``fov_video``, whose bounds are the first and the last pixel.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from gsstream.core.errors import SourceError
from gsstream.input.recordings.foreign import Keys, check_keys, parsed, pixels, reading
from gsstream.input.recordings.lens import Lens
from gsstream.input.recordings.poses import OPENGL_TO_OPENCV, from_pixel_centers
from gsstream.input.recordings.rigs.camera import RigCamera

SUFFIXES = (".txt", ".xml")
UNIT = 1 / 64
#: Attributes of ``intrinsic``; attributes of the sensor and the lens in millimetres do not determine pixels.
_KEYS = Keys(
    read="""
        focalLengthU focalLengthV centerPointU centerPointV radialDistortion1 radialDistortion2 radialDistortion3
        tangentalDistortion1 tangentalDistortion2
    """,
    idle="focallength sensorMinU sensorMaxU sensorMinV sensorMaxV",
    refused="skew radialDistortion4 radialDistortion5 radialDistortion6",
)


def read(path: Path, text: str) -> list[RigCamera]:
    """Return the cameras of a file; none when it is of another format."""
    if "<calibration" not in text or "<intrinsic" not in text or "focalLengthU" not in text:
        return []
    with reading(path, "a calibration of Qualisys"):
        root = ElementTree.fromstring(text)
        return [_camera(path, entry) for entry in root.iter("camera") if entry.get("active", "1") != "0"]


def _camera(path: Path, entry: ElementTree.Element) -> RigCamera:
    name = entry.attrib["serial"]
    if entry.get("viewrotation", "0") != "0":
        raise SourceError(f"{path}: camera {name!r}: its view is turned (viewrotation); expected 0: export it unturned")
    pose, lens, view = (entry.find(part) for part in ("transform", "intrinsic", "fov_video"))
    if pose is None or lens is None or view is None:
        raise SourceError(f"{path}: camera {name!r} needs transform, intrinsic and fov_video")

    def number(of: ElementTree.Element, key: str) -> float:
        return float(parsed(f"{path}: camera {name!r}", key, [of.attrib[key]], 1)[0])

    check_keys(f"{path}: camera {name!r}", [lens.attrib], _KEYS)
    w2c = np.eye(4)
    w2c[:3, :3] = [[number(pose, f"r{row}{column}") for column in (1, 2, 3)] for row in (1, 2, 3)]
    w2c[:3, 3] = -w2c[:3, :3] @ [number(pose, axis) for axis in "xyz"]
    left, right, top, bottom = (int(number(view, side)) for side in ("left", "right", "top", "bottom"))
    fx, fy, cx, cy = (UNIT * number(lens, f"{what}{axis}") for what in ("focalLength", "centerPoint") for axis in "UV")
    radial = [number(lens, f"radialDistortion{i}") for i in (1, 2, 3)]
    p1, p2 = (number(lens, f"tangentalDistortion{i}") for i in (1, 2))  # the format's own spelling
    K = np.array([[fx, 0, cx - left], [0, fy, cy - top], [0, 0, 1.0]])
    where = f"{path}: camera {name!r}: fov_video"
    size = pixels(where, "width", right - left + 1), pixels(where, "height", bottom - top + 1)
    return RigCamera(
        name=name,
        w2c=OPENGL_TO_OPENCV @ w2c,
        K=from_pixel_centers(K),
        lens=Lens("radial", tuple(radial), (p1, p2)),
        size=size,
    )
