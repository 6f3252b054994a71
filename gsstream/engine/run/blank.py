"""Warnings of pictures that show nothing: of frame 0, once something appears, and of a camera from some frame on."""

from __future__ import annotations

import numpy as np

from gsstream.core.frame import Frame

#: Standard deviation, of values in [0, 1], below which a picture shows nothing; and distance of the pixels that are
#: looked at.
STRUCTURE, STEP = 0.01, 8


def are_blank(frame: Frame) -> list[bool]:
    """Return of each picture whether it shows nothing: one colour, and a camera's noise."""
    scale = 255.0 if frame.images.dtype == np.uint8 else 1.0
    return [float(np.std(image[::STEP, ::STEP])) < STRUCTURE * scale for image in frame.images]


def blank_views(frame: Frame) -> int:
    """Return how many of a frame's pictures show nothing."""
    return sum(are_blank(frame))


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


class BlankCameras:
    """Watches for cameras that show nothing any more; of each one sentence."""

    def __init__(self) -> None:
        self._showed: set[str] | None = None

    def look(self, frame: Frame) -> str:
        """Return what is to be said of this frame, which follows the one that was looked at before; mostly nothing."""
        ids = frame.cameras.ids
        blank = {name for name, nothing in zip(ids, are_blank(frame), strict=True) if nothing}
        if self._showed is None:
            self._showed = set(ids) - blank
            return ""
        gone = sorted(self._showed & blank)
        self._showed -= blank
        if not gone:
            return ""
        return (
            f"camera {', '.join(gone)} shows nothing in frame {frame.index}, but one colour, which is fitted like any "
            "picture: see whether it has failed or somebody stands before it"
        )
