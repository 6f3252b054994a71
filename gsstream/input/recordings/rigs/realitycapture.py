"""RealityCapture (RealityScan): metadata beside the pictures (``*.xmp``) or "internal/external parameters" (``*.csv``).

Lengths are shares of the longer side: the focal length of 35 mm film over 36, the principal point from the middle (the
table has it in film millimetres). XMP: rotation row by row, world to camera with OpenCV axes, and the centre. CSV:
heading, pitch and roll in degrees, and the centre; a line with the number of cameras may come first.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from gsstream.core.errors import SourceError
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.foreign import Keys, check_keys, parsed, reading, warn
from gsstream.input.recordings.lens import Lens
from gsstream.input.recordings.poses import from_opengl, from_rotation_vector
from gsstream.input.recordings.rigs.camera import RigCamera

SUFFIXES = (".xmp", ".csv")
FILM = 36.0
_SPACE = "{http://www.capturingreality.com/ns/xcr/1.1#}"
#: By RealityCapture's page on metadata; priors and groups steer an alignment.
_METADATA = Keys(
    read="""
        Rotation Position DistortionModel DistortionCoeficients FocalLength35mm PrincipalPointU PrincipalPointV
        AspectRatio
    """,
    idle="""
        Version PosePrior Coordinates CalibrationPrior CalibrationGroup DistortionGroup Rig RigInstance
        RigPoseIndex InTexturing InMeshing InColoring ComponentId
    """,
    refused="Skew",
)
_OPTICS, _LENS = ("f", "px", "py"), ("k1", "k2", "k3", "k4", "t1", "t2")
_PLACE, _TURN = ("x", "y", "alt"), ("heading", "pitch", "roll")
_COLUMNS = Keys(read="#name x y alt heading pitch roll f px py k1 k2 k3 k4 t1 t2", refused="skew aspect")


def read(path: Path, text: str) -> list[RigCamera]:
    """Return the camera of an XMP file, or all of a table; none when it is of another format."""
    with reading(path, "cameras of RealityCapture"):
        if "capturingreality.com/ns/xcr" in text:
            return [_from_metadata(path, ElementTree.fromstring(text))]
        lines = text.splitlines()
        lines = lines[bool(lines) and lines[0].startswith("#cameras") :]
        if lines and lines[0].startswith("#name,") and "heading" in lines[0]:
            if lost := [name for name in (*_OPTICS[1:], *_LENS) if name not in lines[0].split(",")]:
                warn(f"{path}: columns that the table does not have count as zero: {', '.join(lost)}")
            return [_from_row(path, row) for row in csv.DictReader(lines, restkey="(columns without a name)")]
    return []


def _from_metadata(path: Path, root: ElementTree.Element) -> RigCamera:
    found = {key: value for entry in root.iter() for key, value in entry.attrib.items()}
    found |= {entry.tag: entry.text or "" for entry in root.iter() if not len(entry)}
    found = {key.removeprefix(_SPACE): value for key, value in found.items() if key.startswith(_SPACE)}
    check_keys(str(path), [found], _METADATA)

    def numbers(key: str, *counts: int) -> FloatArray:
        return parsed(str(path), key, found[key].split(), *counts)

    if not {"Rotation", "Position"} <= set(found):  # it steers an alignment that has not been
        return RigCamera(name=path.stem, w2c=None, K=np.eye(3), lens=Lens("radial", ()), size=None)
    w2c = np.eye(4)
    w2c[:3, :3] = numbers("Rotation", 9).reshape(3, 3)
    w2c[:3, 3] = -w2c[:3, :3] @ numbers("Position", 3)
    model, coefficients = found["DistortionModel"], numbers("DistortionCoeficients", 6)  # the format's own spelling
    if not model.startswith("brown") and coefficients.any():
        raise SourceError(f"{path}: the lens model {model!r} is not supported; export with a model of Brown")
    if "AspectRatio" in found and numbers("AspectRatio", 1)[0] != 1:
        raise SourceError(f"{path}: expected AspectRatio 1, got {found['AspectRatio']}; align with square pixels")
    u, v = numbers("PrincipalPointU", 1)[0], numbers("PrincipalPointV", 1)[0]
    optics = (numbers("FocalLength35mm", 1)[0] / FILM, u, v)
    return _made(path.stem, w2c, optics=optics, coefficients=coefficients)


def _from_row(path: Path, row: dict[str, str]) -> RigCamera:
    check_keys(str(path), [row], _COLUMNS)
    name = Path(row["#name"]).stem

    def numbers(keys: Sequence[str]) -> FloatArray:
        return parsed(
            f"{path}: camera {name!r}",
            ", ".join(keys),
            [row[key] if key in row or key not in (*_OPTICS[1:], *_LENS) else 0 for key in keys],
        )

    heading, pitch, roll = np.radians(numbers(_TURN))
    turns = zip((2, 0, 1), (-heading, pitch, roll), strict=True)
    z, x, y = (from_rotation_vector(angle * np.eye(3)[axis]) for axis, angle in turns)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = z @ x @ y, numbers(_PLACE)
    f, u, v = numbers(_OPTICS) / FILM
    return _made(name, from_opengl(pose), optics=(f, u, v), coefficients=numbers(_LENS))


def _made(name: str, w2c: FloatArray, optics: tuple[float, float, float], coefficients: FloatArray) -> RigCamera:
    k1, k2, k3, k4, t1, t2 = coefficients.tolist()
    f, u, v = optics
    K = np.array([[f, 0, u], [0, f, v], [0, 0, 1.0]])
    return RigCamera(name=name, w2c=w2c, K=K, lens=Lens("radial", (k1, k2, k3), (t1, t2), eighth=k4), size=None)
