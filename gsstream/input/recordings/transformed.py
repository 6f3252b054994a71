"""A recording seen through ``DataOptions``: another split, and what is done about images that cannot be read."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from gsstream.core.errors import EndOfRecording, SourceError
from gsstream.core.frame import Frame, PointCloud
from gsstream.core.shapes import FloatArray
from gsstream.core.storage import unpacked
from gsstream.input.recordings.base import Moment, PointKind, Source, SourceInfo, Split, Wrapped, assembled
from gsstream.input.recordings.options import DataOptions
from gsstream.input.recordings.sync import RecordingWarning
from gsstream.input.recordings.transforms import choose_split


def transformed(source: Source, options: DataOptions) -> Source:
    """Return ``source`` as ``options`` want it; the very same object when they change nothing.

    Raises SourceError when an option names a camera that does not exist or leaves nothing to train on.
    """
    return source if options.touches_nothing else TransformedSource(source, options)


class TransformedSource(Wrapped):
    """A source over another one, with another split. Thread-safe when the inner source is."""

    def __init__(self, source: Source, options: DataOptions) -> None:
        super().__init__(source)
        self._options, info = options, source.info
        both = info.train.joined(info.test)
        train, test, self._away = choose_split(options, info.train, info.test)
        place = both.ids.index
        self._info = replace(
            info, train=both.select([place(i) for i in train]), test=both.select([place(i) for i in test])
        )

    @property
    def info(self) -> SourceInfo:
        """The inner recording's, with the cameras of this split."""
        return self._info

    def frame(self, index: int, split: Split = "train") -> Frame:
        """Read one instant. Raises SourceError as the inner source does."""
        return self.stored_frame(index, split).as_float32()

    def image(self, index: int, camera: str) -> FloatArray:
        """Return one camera's image, or what stands in for one that cannot be read."""
        return unpacked(self.stored_image(index, camera))

    def stored_image(self, index: int, camera: str) -> Any:
        """Return one camera's image as it is stored, or what stands in for one that cannot be read."""
        return self._whole(index, camera)[0]

    def stored_frame(self, index: int, split: Split = "train") -> Frame:
        """Read one instant as it is stored. Raises SourceError as the inner source does."""
        bad = False

        def read(index: int, camera: str) -> Any:
            nonlocal bad
            image, shown = self._whole(index, camera)
            bad |= shown != index
            return image

        frame = assembled(self, index, split, read)
        if bad and split == "test":  # no render is compared with an image of another time
            return replace(frame, cameras=frame.cameras.select([]), images=frame.images[:0])
        return replace(frame, epoch_scale=0.0) if bad and self._options.bad_image == "drop" else frame

    def moment(self, index: int) -> Moment:
        """Return what the inner source says of an instant; absent are training cameras of this split alone."""
        moment = self._source.moment(index)
        if moment.arrival is None:
            return moment
        absent = tuple(name for name in self._info.train.ids if name in moment.arrival.absent)
        return replace(moment, arrival=replace(moment.arrival, absent=absent))

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
        return self._source.points_without((*cameras, *self._away), kind)

    def _whole(self, index: int, camera: str) -> tuple[Any, int]:
        """A camera's image of a frame, or where it cannot be read its last one before that, and whose frame it is."""
        while True:
            try:
                return self._source.stored_image(index, camera), index
            except EndOfRecording:
                raise
            except SourceError as error:
                if self._options.bad_image == "stop" or index == 0:
                    raise
                what = "the camera's last image stands in" if self._options.bad_image == "repeat" else "it is left out"
                warnings.warn(f"frame {index}, camera {camera!r}: {error}; {what}", RecordingWarning, stacklevel=2)
                index -= 1
