"""Agisoft Metashape's cameras (``File > Export > Export Cameras``, XML).

``sensor``: ``resolution`` and ``calibration`` (f, cx and cy from the middle of the picture, k1 ... k4, p1 and p2 in the
other order than OpenCV's, b1, b2). ``camera``: ``label``, ``sensor_id`` and ``transform``, camera to chunk with OpenCV
axes; the coordinates are those of the chunk.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from gsstream.core.errors import SourceError
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.lens import Lens
from gsstream.input.recordings.poses import invert
from gsstream.input.recordings.rigs.camera import RigCamera

SUFFIXES = (".xml",)
Optics = tuple[FloatArray, Lens, tuple[int, int]]


def read(path: Path, text: str) -> list[RigCamera]:
    """Return the placed cameras of a file; none when it is of another format."""
    if "<document" not in text or "<sensors" not in text:
        return []
    try:
        root = ElementTree.fromstring(text)
        sensors = {entry.attrib["id"]: entry for entry in root.iter("sensor")}
        placed = [entry for entry in root.iter("camera") if entry.findtext("transform")]
        return [_camera(entry, _optics(path, sensors[entry.attrib["sensor_id"]])) for entry in placed]
    except (ElementTree.ParseError, KeyError, ValueError) as error:
        raise SourceError(f"{path}: not cameras of Metashape: {error!r}") from error


def _camera(entry: ElementTree.Element, optics: Optics) -> RigCamera:
    K, lens, size = optics
    pose = np.array([float(word) for word in (entry.findtext("transform") or "").split()]).reshape(4, 4)
    return RigCamera(name=Path(entry.attrib["label"]).stem, w2c=invert(pose), K=K, lens=lens, size=size)


def _optics(path: Path, sensor: ElementTree.Element) -> Optics:
    where = f"{path}: sensor {sensor.get('label', sensor.get('id'))!r}"
    found = sensor.findall("calibration")
    calibration = next((entry for entry in found if entry.get("class") == "adjusted"), found[0] if found else None)
    resolution = sensor.find("resolution")
    if calibration is None or resolution is None or sensor.get("type", "frame") != "frame":
        raise SourceError(f"{where}: expected type 'frame', a resolution and a calibration")

    def number(key: str) -> float:
        return float(calibration.findtext(key) or 0)

    if number("k4") or number("b2"):
        raise SourceError(f"{where}: k4 and b2 (skew) are not supported: optimise the cameras without them")
    width, height = int(resolution.attrib["width"]), int(resolution.attrib["height"])
    f, cx, cy = number("f"), width / 2 + number("cx"), height / 2 + number("cy")
    K = np.array([[f + number("b1"), 0, cx], [0, f, cy], [0, 0, 1.0]])
    lens = Lens("radial", (number("k1"), number("k2"), number("k3")), (number("p2"), number("p1")))
    return K, lens, (width, height)
