"""FrameSource: synchronised frames of a calibrated rig, in time order, with random access."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

from gsstream.core.cameras import Cameras
from gsstream.core.errors import SourceError
from gsstream.core.frame import Frame, PointCloud
from gsstream.core.shapes import FloatArray
from gsstream.core.world import IDENTITY, World

Split = Literal["train", "test"]
PointKind = Literal["recording", "sparse"]


class FilesMissing(SourceError):
    """Pictures that a recording declares are not there; the calibration itself may be sound."""


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
        world: where the coordinates of these cameras lie in those of the files; sources of files leave it alone.
        depth_maps: folder of depth maps of frame 0 (:mod:`gsstream.input.recordings.depth_maps`); None: there is none.
    """

    name: str
    uri: str
    num_frames: int | None
    fps: float
    train: Cameras
    test: Cameras
    licence: str = ""
    world: World = IDENTITY
    depth_maps: Path | None = None


class FrameSource(Protocol):
    """A recording. Reading a frame twice gives the same bits."""

    @property
    def info(self) -> SourceInfo: ...

    def frame(self, index: int, split: Split = "train") -> Frame:
        """Read one instant. Raises SourceError naming the file when an image is missing or unreadable."""

    def points(self, kind: PointKind = "recording") -> PointCloud | None:
        """Return points of frame 0 that ship with the recording (never derived from test cameras), or None.

        ``kind``: "recording", or "sparse" for a thinned, noisier stand-in where one ships.
        """

    def close(self) -> None:
        """Release files and threads."""


@runtime_checkable
class SingleImages(Protocol):
    """A source that can also give one camera's image without decoding the others'."""

    def image(self, index: int, camera: str) -> FloatArray:
        """Return [H, W, 3] float32 in [0, 1] of one camera, of either split; the same bits as in ``frame``."""


@runtime_checkable
class StoredImages(Protocol):
    """A source whose files may hold 8 bits: a frame that waits as bytes then never is float32."""

    def stored_image(self, index: int, camera: str) -> Any:
        """Return what ``image`` does as uint8, of which 255 is 1.0, where that has the same bits; else float32."""


@runtime_checkable
class AttributedPoints(Protocol):
    """A source that can also give points by the cameras that took part in them."""

    def points_without(self, cameras: Sequence[str], kind: PointKind = "recording") -> PointCloud | None:
        """Return the points in which none of these cameras took part; None when none are left."""


def check_index(info: SourceInfo, index: int) -> None:
    """Raise SourceError when a recording has no such frame."""
    if index < 0 or (info.num_frames is not None and index >= info.num_frames):
        raise SourceError(
            f"recording {info.name!r} has no frame {index}; it has {info.num_frames}, counted from 0 "
            "(lower the number of frames, or record more)"
        )


@runtime_checkable
class LiveSource(FrameSource, Protocol):
    """A recording that is still being written: ``frame`` waits, and raises EndOfRecording after the last one."""

    def interrupt(self) -> None:
        """End all waits: frames that are not there yet raise EndOfRecording from now on."""


@runtime_checkable
class AdaptiveSource(LiveSource, Protocol):
    """A growing recording that may ask for less work on a frame when the run has fallen behind."""

    def epoch_scale(self, index: int) -> float:
        """Return the share of the epochs that a frame is worth, now that it is to be encoded; 0: an empty packet."""
