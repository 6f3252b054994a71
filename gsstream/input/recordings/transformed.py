"""A recording seen through ``DataOptions`` and ``Disturbances``: another split, bad images, noise, losses, ..."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from gsstream.core.errors import EndOfRecording, SourceError
from gsstream.core.frame import Arrival, Frame, PointCloud
from gsstream.core.rng import Rng
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.base import (
    AdaptiveSource,
    AttributedPoints,
    FrameSource,
    LiveSource,
    PointKind,
    SingleImages,
    SourceInfo,
    Split,
    check_index,
)
from gsstream.input.recordings.options import UNDISTURBED, DataOptions, Disturbances
from gsstream.input.recordings.sync import RecordingWarning
from gsstream.input.recordings.transforms import (
    choose_split,
    gain_at,
    is_lost,
    parse_losses,
    parse_offsets,
    with_gain,
    with_noise,
)

SPLITS: tuple[Split, ...] = ("train", "test")


def transformed(source: FrameSource, options: DataOptions) -> FrameSource:
    """Return ``source`` as ``options`` want it; the very same object when they change nothing.

    Raises SourceError when an option names a camera that does not exist or leaves nothing to train on.
    """
    return source if options.touches_nothing else TransformedSource(source, options)


class TransformedSource:
    """A frame source over another one. Thread-safe when the inner source is; equal seeds give equal disturbances.

    Frame t of the run is frame ``start + t + offset`` of the recording for each camera, where ``start`` makes room for
    negative offsets; the run is shorter by the span of the offsets, so that no frame is shown twice.
    Order: time offset, gain (all cameras), noise, losses and the rounding of storage (training cameras).
    """

    def __init__(
        self, source: FrameSource, options: DataOptions, disturbances: Disturbances = UNDISTURBED, seed: int = 0
    ) -> None:
        self._source, self._options, self._disturbances, self._rng = source, options, disturbances, Rng(seed)
        info = source.info
        both = info.train.joined(info.test)
        self._home: dict[str, Split] = dict.fromkeys(info.test.ids, "test")
        self._home.update(dict.fromkeys(info.train.ids, "train"))
        train, test, self._away = choose_split(options, info.train, info.test)
        self._offsets = parse_offsets(disturbances.time_offset, both.ids)
        self._losses = parse_losses(disturbances.lost_cameras, train)
        used = [self._offsets.get(i, 0) for i in {*train, *test}]
        self._start = max(0, -min(used))
        frames = info.num_frames
        if frames is not None:
            frames -= self._start + max(0, *used)
            if frames < 1:
                raise SourceError(
                    f"disturbed source: time_offset: offsets from {min(used)} to {max(used)} leave no common frame of "
                    f"the {info.num_frames} that {info.name!r} has; use smaller offsets"
                )
        place = both.ids.index
        self._info = replace(
            info,
            num_frames=frames,
            train=both.select([place(i) for i in train]),
            test=both.select([place(i) for i in test]),
        )

    @property
    def info(self) -> SourceInfo:
        """The inner recording's, with the cameras and the number of frames that are left."""
        return self._info

    def frame(self, index: int, split: Split = "train") -> Frame:
        """Read one instant. Raises SourceError as the inner source does."""
        check_index(self._info, index)
        cameras = self._info.train if split == "train" else self._info.test
        images: FloatArray = np.empty((len(cameras), cameras.height, cameras.width, 3), np.float32)
        cache: dict[tuple[int, Split], Frame] = {}
        if isinstance(self._source, LiveSource):
            # Its frames say how much they are worth, and which test cameras are there: both are read first.
            cache = {(self._start + index, home): self._source.frame(self._start + index, home) for home in SPLITS}
            there = {name for frame in cache.values() for name in frame.cameras.ids}
            cameras = cameras if there.issuperset(cameras.ids) else cameras.select([])
            images = images[: len(cameras)]
        epoch_scale = min((frame.epoch_scale for frame in cache.values()), default=1.0)
        bad = False
        for row, name in enumerate(cameras.ids):
            shown = self._delivered_frame(name, index) if split == "train" else index
            if shown is not None:
                images[row], read = self._whole(name, shown, split, cache)
                bad |= read != shown
            else:
                images[row] = 0
        if bad and split == "test":  # nothing is measured against an image of another time
            cameras, images = cameras.select([]), images[:0]
        if bad and split == "train" and self._options.bad_image == "drop":
            epoch_scale = 0.0
        return Frame(
            index=index,
            timestamp=index / self._info.fps,
            images=images,
            cameras=cameras,
            epoch_scale=epoch_scale,
            arrival=self._arrival(cache.values()),
        )

    def _arrival(self, read: Collection[Frame]) -> Arrival | None:
        """How a frame came in that is made of these of the inner source: with the last of them."""
        came = [frame.arrival for frame in read if frame.arrival is not None]
        if not came:
            return None
        missing = {name for arrival in came for name in arrival.absent}
        return Arrival(
            max((arrival.complete for arrival in came if arrival.complete is not None), default=None),
            tuple(name for name in self._info.train.ids if name in missing),
        )

    def points(self, kind: PointKind = "recording") -> PointCloud | None:
        """Return the inner source's points, unless a test camera of this split took part in them.

        Sources that know who took part in which point leave those points out; the points of others are withheld (None)
        when a camera that they count as training is a test camera here. ``leak`` lifts both.
        """
        return self.points_without(self._info.test.ids if self._options.leak == "none" else (), kind)

    def points_without(self, cameras: Sequence[str], kind: PointKind = "recording") -> PointCloud | None:
        """Return the points in which none of these cameras can have taken part; None when none are left.

        Nor can the test cameras that the tuning split took away.
        """
        cameras = (*cameras, *self._away)
        if isinstance(self._source, AttributedPoints):
            return self._source.points_without(cameras, kind)
        taken = any(self._home[name] == "train" for name in cameras)
        return None if taken else self._source.points(kind)

    def interrupt(self) -> None:
        """End the waits of an inner source that grows; others never wait."""
        if isinstance(self._source, LiveSource):
            self._source.interrupt()

    def epoch_scale(self, index: int) -> float:
        """Return what a frame of an inner source that grows is worth now; 1 of any other."""
        return self._source.epoch_scale(self._start + index) if isinstance(self._source, AdaptiveSource) else 1.0

    def close(self) -> None:
        """Close the inner source."""
        self._source.close()

    def _delivered_frame(self, name: str, index: int) -> int | None:
        """The frame whose image this camera delivers at ``index``; None: a black one."""
        while is_lost(self._disturbances, self._losses, name, index=index, rng=self._rng):
            if self._disturbances.lost_as == "black":
                return None
            index -= 1
        return index

    def _whole(
        self, name: str, index: int, split: Split, cache: dict[tuple[int, Split], Frame]
    ) -> tuple[FloatArray, int]:
        """A camera's image of a frame, or where it cannot be read its last one before that, and whose frame it is."""
        while True:
            try:
                return self._image(name, index, split, cache), index
            except EndOfRecording:
                raise
            except SourceError as error:
                if self._options.bad_image == "stop" or index == 0:
                    raise
                what = "the camera's last image stands in" if self._options.bad_image == "repeat" else "it is left out"
                warnings.warn(f"frame {index}, camera {name!r}: {error}; {what}", RecordingWarning, stacklevel=2)
                index -= 1

    def _image(self, name: str, index: int, split: Split, cache: dict[tuple[int, Split], Frame]) -> FloatArray:
        options = self._disturbances
        image = self._read(name, self._start + index + self._offsets.get(name, 0), cache)
        image = with_gain(image, gain_at(options, index, self._rng))
        if split == "train" and options.noise_sigma > 0 and index < options.noise_frames:
            image = with_noise(image, options.noise_sigma, name, index=index, rng=self._rng)
        return image

    def _read(self, name: str, index: int, cache: dict[tuple[int, Split], Frame]) -> FloatArray:
        """One camera's image; a source that only has whole frames is asked for each of them once."""
        if isinstance(self._source, SingleImages):
            return self._source.image(index, name)
        key = (index, self._home[name])
        if key not in cache:
            cache[key] = self._source.frame(*key)
        frame = cache[key]
        image: FloatArray = frame.images[frame.cameras.ids.index(name)]
        return image
