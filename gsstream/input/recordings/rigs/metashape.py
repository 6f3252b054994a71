"""Agisoft Metashape's cameras (``File > Export > Export Cameras``, XML).

``sensor``: ``resolution`` and ``calibration`` (f, cx and cy from the middle of the picture, k1 ... k4, p1 and p2 in the
other order than OpenCV's, b1, b2). ``camera``: ``label``, ``sensor_id`` and ``transform``, camera to chunk with OpenCV
axes; the coordinates are those of the chunk, or of the component with the most cameras. Disabled cameras do not count.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path, PurePosixPath
from xml.etree import ElementTree

import numpy as np

from gsstream.core.errors import SourceError
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.foreign import Keys, check_keys, left_out, parsed, pixels, reading
from gsstream.input.recordings.lens import Lens
from gsstream.input.recordings.poses import invert
from gsstream.input.recordings.rigs.camera import RigCamera

SUFFIXES = (".xml",)
Optics = tuple[FloatArray, Lens, tuple[int, int] | None]
#: Elements of a calibration.
_KEYS = Keys(
    read="resolution f cx cy k1 k2 k3 k4 p1 p2 b1 b2",
    idle="covariance date params meta",
    refused="p3 p4 fx fy skew rolling_shutter",
)


def read(path: Path, text: str) -> list[RigCamera]:
    """Return the cameras of a file; none when it is of another format."""
    if "<document" not in text or "<sensors" not in text:
        return []
    with reading(path, "cameras of Metashape"):
        root = ElementTree.fromstring(text)
        sensors = {entry.attrib["id"]: entry for entry in root.iter("sensor")}
        optics = {
            name: _optics(path, entry) for name, entry in sensors.items() if entry.find("calibration") is not None
        }
        entries = [
            entry
            for entry in root.iter("camera")
            if "label" in entry.attrib and entry.get("enabled", "true") not in ("false", "0")
        ]
        return [_camera(path, entry, optics) for entry in _of_one_component(path, entries)]


def _of_one_component(path: Path, entries: list[ElementTree.Element]) -> list[ElementTree.Element]:
    """Cameras of different components have coordinates that nothing joins: those of the largest, and those of none."""
    sizes = Counter(entry.get("component_id") for entry in entries if entry.find("transform") is not None)
    first = sizes.most_common(1)[0][0] if sizes else None
    other = [entry for entry in entries if sizes[entry.get("component_id")] and entry.get("component_id") != first]
    left_out(str(path), "of other components", [entry.attrib["label"] for entry in other], len(entries) - len(other))
    return [entry for entry in entries if entry not in other]


def _camera(path: Path, entry: ElementTree.Element, optics: dict[str, Optics]) -> RigCamera:
    """A camera; one that was not aligned, or whose sensor was not calibrated, has no pose."""
    label, sensor, transform = entry.attrib["label"], entry.attrib["sensor_id"], entry.findtext("transform")
    K, lens, size = optics.get(sensor, (np.eye(3), Lens("radial", ()), None))
    w2c = None
    if transform and sensor in optics:
        w2c = invert(parsed(f"{path}: camera {label!r}", "transform", transform.split(), 16).reshape(4, 4))
    name = PurePosixPath(label.replace("\\", "/")).stem
    return RigCamera(name=name, w2c=w2c, K=K, lens=lens, size=size)


def _optics(path: Path, sensor: ElementTree.Element) -> Optics:
    where = f"{path}: sensor {sensor.get('label', sensor.get('id'))!r}"
    found = sensor.findall("calibration")
    calibration = next((entry for entry in found if entry.get("class") == "adjusted"), found[0] if found else None)
    resolution = sensor.find("resolution")
    if calibration is None or resolution is None or sensor.get("type", "frame") != "frame":
        raise SourceError(f"{where}: expected type 'frame', a resolution and a calibration")

    def number(key: str) -> float:
        return float(parsed(where, key, [calibration.findtext(key) or 0], 1)[0])

    check_keys(where, [{part.tag: part.text for part in calibration}], _KEYS)
    width, height = (pixels(where, key, int(resolution.attrib[key])) for key in ("width", "height"))
    f, cx, cy = number("f"), width / 2 + number("cx"), height / 2 + number("cy")
    K = np.array([[f + number("b1"), 0, cx], [0, f, cy], [0, 0, 1.0]])
    k, p = (number("k1"), number("k2"), number("k3")), (number("p2"), number("p1"))
    lens = Lens("radial", k, p, eighth=number("k4"), skew=number("b2") / K[0, 0] if K[0, 0] else 0.0)
    return K, lens, (width, height)
