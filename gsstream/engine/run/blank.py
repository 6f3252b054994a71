"""A warning where frame 0 shows nothing, given when something appears, which then has to grow from nothing."""

from __future__ import annotations

import numpy as np

from gsstream.core.frame import Frame

#: Standard deviation, of values in [0, 1], below which a picture shows nothing; and distance of the pixels that are
#: looked at.
STRUCTURE, STEP = 0.01, 8


def blank_views(frame: Frame) -> int:
    """Return how many of a frame's pictures show nothing: one colour, and a camera's noise."""
    scale = 255.0 if frame.images.dtype == np.uint8 else 1.0
    return sum(float(np.std(image[::STEP, ::STEP])) < STRUCTURE * scale for image in frame.images)


def start_numbers(frame: Frame) -> dict[str, int]:
    """Return what the line of frame 0 says of its pictures; nothing for a later frame."""
    return {"blank_views": blank_views(frame)} if frame.index == 0 else {}


class BlankStart:
    """Watches for the first pictures that show something, where those of frame 0 showed nothing."""

    def __init__(self) -> None:
        self._waits = False

    def look(self, frame: Frame) -> str:
        """Return what is to be said of this frame, which follows the one that was looked at before; mostly nothing."""
        if frame.index == 0:
            self._waits = blank_views(frame) == len(frame.images)
            return (
                "frame 0 shows nothing in any training camera: there is nothing to build a scene of, and what comes "
                "later can hardly be added; begin the recording at a frame that shows the scene"
                if self._waits
                else ""
            )
        if not self._waits or blank_views(frame) == len(frame.images):
            return ""
        self._waits = False
        return (
            f"frame {frame.index} is the first that shows something, and frame 0, which everything is built on, showed "
            "nothing: this stream stays poor; begin anew with --overwrite and a recording without the frames before it"
        )
