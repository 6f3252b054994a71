"""Source: synchronised frames of a calibrated rig, in time order, with random access."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.errors import SourceError
from gsstream.core.frame import Arrival, Frame, PointCloud, packed_frame
from gsstream.core.shapes import FloatArray
from gsstream.core.storage import packed, unpacked
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
        uri: the address by which it was opened.
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


@dataclass(frozen=True, slots=True)
class Moment:
    """What a recording says of an instant beside its images.

    Arguments:
        epoch_scale: share of the recipe's epochs that the frame is worth, in [0, 1].
        arrival: how the frame arrived; None for a recording that is not live.
        held: ids of the cameras whose image is of an earlier instant.
    """

    epoch_scale: float = 1.0
    arrival: Arrival | None = None
    held: tuple[str, ...] = ()


class Source(ABC):
    """A recording. Reading a frame twice gives the same bits, from any thread.

    A subclass writes ``info`` and ``frame``; every other method has a default. One that reads one camera's image
    without the others is a :class:`CameraSource`.
    """

    @property
    @abstractmethod
    def info(self) -> SourceInfo:
        """What the recording says about itself; cameras at the size that ``frame`` delivers."""

    @abstractmethod
    def frame(self, index: int, split: Split = "train") -> Frame:
        """Read one instant, with images of float32.

        Raises SourceError naming the file when an image is missing or unreadable. A recording that is still being
        written waits for the frame, and raises EndOfRecording after the last one.
        """

    def image(self, index: int, camera: str) -> FloatArray:
        """Return [H, W, 3] float32 in [0, 1] of one camera, of either split; the same bits as in ``frame``."""
        frame = self.frame(index, "train" if camera in self.info.train.ids else "test")
        image: FloatArray = frame.images[frame.cameras.ids.index(camera)]
        return image

    def stored_image(self, index: int, camera: str) -> Any:
        """Return what ``image`` does as uint8, of which 255 is 1.0, where that has the same bits; else float32."""
        return packed(self.image(index, camera))

    def stored_frame(self, index: int, split: Split = "train") -> Frame:
        """Return what ``frame`` does, with images of uint8 where that has the same bits for all of them."""
        return packed_frame(self.frame(index, split))

    @property
    def stores_bytes(self) -> bool:
        """Whether every stored image is uint8; a budget of memory counts on it. False: some may be float32."""
        return False

    def points(self, kind: PointKind = "recording") -> PointCloud | None:
        """Return points of frame 0 that ship with the recording (never derived from test cameras), or None.

        ``kind``: "recording", or "sparse" for a thinned, noisier stand-in where one ships.
        """
        return None

    def points_without(self, cameras: Sequence[str], kind: PointKind = "recording") -> PointCloud | None:
        """Return the points in which none of these cameras took part; None when none are left.

        Every training camera counts as having taken part in every point, unless a source knows better.
        """
        return None if set(cameras) & set(self.info.train.ids) else self.points(kind)

    def moment(self, index: int) -> Moment:
        """Return what is known of an instant; a recording that is still being written waits for it."""
        return Moment()

    def epoch_scale(self, index: int) -> float:
        """Return the share of the epochs that a frame is worth when its turn has come; 0: an empty packet.

        A recording that is still being written asks for less when the run has fallen behind.
        """
        return 1.0

    def waiting(self, index: int) -> int:
        """Return how many later frames have come when a frame's turn has come; 0 for a recording that is not live."""
        return 0

    def go_on_at(self, index: int, past: Mapping[int, Moment]) -> None:  # noqa: B027  # most files say all there is
        """Take frames before this one for done: another run has encoded them, and ``past`` says how they came in.

        A recording that is still being written must neither wait for them nor count them as waiting.
        """

    def interrupt(self) -> None:  # noqa: B027  # most recordings are never waited for
        """End all waits: frames that are not there yet raise EndOfRecording from now on."""

    def close(self) -> None:  # noqa: B027  # most recordings keep nothing open
        """Release files and threads."""


class CameraSource(Source):
    """A source that reads one camera's image at a time: a subclass writes ``info`` and ``stored_image``."""

    def frame(self, index: int, split: Split = "train") -> Frame:
        """Read one instant. Raises SourceError naming the file when a picture is missing or damaged."""
        return self.stored_frame(index, split).as_float32()

    def image(self, index: int, camera: str) -> FloatArray:
        """Return one camera's image [H, W, 3] float32 in [0, 1]."""
        return unpacked(self.stored_image(index, camera))

    def stored_frame(self, index: int, split: Split = "train") -> Frame:
        """Read one instant as it is stored."""
        return assembled(self, index, split)

    @abstractmethod
    def stored_image(self, index: int, camera: str) -> Any:
        """Return one camera's image as uint8, of which 255 is 1.0, where that holds it; else float32."""


class Wrapped(Source):
    """A source over another one, whose every answer is that of the inner source; subclasses change some.

    Every public method of :class:`Source` stands here, so that none of its defaults answers for the inner source.
    """

    def __init__(self, source: Source) -> None:
        self._source = source

    @property
    def info(self) -> SourceInfo:
        """What the inner source says about itself."""
        return self._source.info

    def frame(self, index: int, split: Split = "train") -> Frame:
        """Read one instant. Raises SourceError as the inner source does."""
        return self._source.frame(index, split)

    def image(self, index: int, camera: str) -> FloatArray:
        """Return one camera's image."""
        return self._source.image(index, camera)

    def stored_image(self, index: int, camera: str) -> Any:
        """Return one camera's image as it is stored."""
        return self._source.stored_image(index, camera)

    def stored_frame(self, index: int, split: Split = "train") -> Frame:
        """Return one instant as it is stored."""
        return self._source.stored_frame(index, split)

    @property
    def stores_bytes(self) -> bool:
        """Whether the inner source hands over bytes."""
        return self._source.stores_bytes

    def points(self, kind: PointKind = "recording") -> PointCloud | None:
        """Return the inner source's points."""
        return self._source.points(kind)

    def points_without(self, cameras: Sequence[str], kind: PointKind = "recording") -> PointCloud | None:
        """Return those of the inner source's points in which none of these cameras took part."""
        return self._source.points_without(cameras, kind)

    def moment(self, index: int) -> Moment:
        """Return what the inner source says of an instant."""
        return self._source.moment(index)

    def epoch_scale(self, index: int) -> float:
        """Return what the inner source says that a frame is worth."""
        return self._source.epoch_scale(index)

    def waiting(self, index: int) -> int:
        """Return how many later frames the inner source has."""
        return self._source.waiting(index)

    def go_on_at(self, index: int, past: Mapping[int, Moment]) -> None:
        """Tell the inner source which frames are done."""
        self._source.go_on_at(index, past)

    def interrupt(self) -> None:
        """End the waits of the inner source."""
        self._source.interrupt()

    def close(self) -> None:
        """Close the inner source."""
        self._source.close()


def assembled(source: Source, index: int, split: Split, read: Callable[[int, str], Any] | None = None) -> Frame:
    """Return a frame made of single stored images: ``source.stored_image`` of its cameras, or what ``read`` gives.

    A frame of uint8 is made picture by picture: no whole frame of float32 is held for it. Test cameras are left out of
    an instant in which one of them holds an earlier image, so that nothing is measured against an image of another
    time.
    """
    moment, info = source.moment(index), source.info
    check_index(info, index)
    cameras = info.train if split == "train" else info.test
    if split == "test" and not set(cameras.ids).isdisjoint(moment.held):
        cameras = cameras.select([])
    images: Any = np.empty((len(cameras), cameras.height, cameras.width, 3), np.uint8)
    for row, name in enumerate(cameras.ids):
        image = (read or source.stored_image)(index, name)
        if image.dtype != images.dtype:  # the first image that no bytes hold: from here on all are float32
            image, images = unpacked(image), unpacked(images)
        images[row] = image
    return Frame(
        index=index,
        timestamp=index / info.fps,
        images=images,
        cameras=cameras,
        epoch_scale=moment.epoch_scale,
        arrival=moment.arrival,
    )


def check_index(info: SourceInfo, index: int) -> None:
    """Raise SourceError when a recording has no such frame."""
    if index < 0 or (info.num_frames is not None and index >= info.num_frames):
        raise SourceError(
            f"recording {info.name!r} has no frame {index}; it has {info.num_frames}, counted from 0 "
            "(lower the number of frames, or record more)"
        )
