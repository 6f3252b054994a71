"""FrameSource: synchronised frames of a calibrated rig, in time order, with random access."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

from gsstream.core.cameras import Cameras
from gsstream.core.frame import Frame, PointCloud

Split = Literal["train", "test"]
PointKind = Literal["recording", "sparse"]


@dataclass(frozen=True, slots=True)
class SourceInfo:
    """What a recording says about itself.

    Arguments:
        name: short name.
        uri: how it was asked for.
        num_frames: number of frames, or None while it grows.
        fps: frames per second.
        train, test: cameras by split; test cameras never enter seeding or training.
        licence: licence or terms of the recording, as text.
    """

    name: str
    uri: str
    num_frames: int | None
    fps: float
    train: Cameras
    test: Cameras
    licence: str = ""


class FrameSource(Protocol):
    """A recording. Reading a frame twice gives the same bits."""

    @property
    def info(self) -> SourceInfo: ...

    def frame(self, index: int, split: Split = "train") -> Frame:
        """Read one instant. Raises SourceError naming the file when an image is missing or unreadable."""

    def points(self, kind: PointKind = "recording") -> PointCloud | None:
        """Points of frame 0 that ship with the recording (never derived from test cameras), or None.

        ``kind``: "recording", or "sparse" for a thinned, noisier stand-in where one ships.
        """

    def close(self) -> None:
        """Release files and threads."""
