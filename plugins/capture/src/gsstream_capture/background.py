"""``gsstream capture --background``: the empty room, the median of thirty instants of each camera."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gsstream_capture.capture import Say, run_capture
from gsstream_capture.pictures import jpeg
from gsstream_capture.report import Report
from gsstream_capture.rig import Rig

#: Instants whose median is the room, and the file's name beside each camera's pictures.
INSTANTS, BACKGROUND = 30, "background.jpg"
#: Rows of all pictures that are looked at together: what bounds the memory.
_ROWS = 64


def save_background(rig: Rig, folder: Path, out: Path, *, say: Say, stopped: threading.Event) -> Report:
    """Capture until every camera has sent thirty pictures, and write ``background.jpg`` beside those of each.

    What moves through a place in fewer than half of them is not in it. ``out`` is a recording all the same. Raises as
    :func:`run_capture`.
    """
    counts = [0] * len(rig.cameras)

    def look(camera: int, _: Any) -> None:
        counts[camera] += 1
        if min(counts) >= INSTANTS:
            stopped.set()

    report = run_capture(rig, folder, out, seconds=None, say=say, stopped=stopped, look=look)
    for camera in rig.cameras:
        paths = sorted((out / camera.id).glob("*.jpg"))
        if paths:
            (out / camera.id / BACKGROUND).write_bytes(jpeg(middle(paths), rig.quality))
            say(f"{camera.id}: {BACKGROUND} is the median of {len(paths)} pictures")
    return report


def middle(paths: list[Path]) -> np.ndarray[Any, Any]:
    """Return [H, W, 3] uint8, blue first: the median of pictures of one size, value by value."""
    pictures = [cv2.imread(str(path), cv2.IMREAD_COLOR) for path in paths]
    rows = range(0, pictures[0].shape[0], _ROWS)  # type: ignore[union-attr]
    parts = [np.median([picture[at : at + _ROWS] for picture in pictures], axis=0) for at in rows]  # type: ignore[index]
    return np.round(np.concatenate(parts)).astype(np.uint8)
