"""Saboteurs of the checks of sources: a sound recording of which one thing is wrong."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from gsstream.core.frame import Frame, PointCloud
from gsstream.core.storage import to_bytes
from gsstream.input.recordings.base import Moment
from gsstream.testing.examples.source import ExampleSource
from gsstream.testing.registry import SourceUnderTest
from saboteurs.register import spoils


def _spoils(check: str) -> Callable[[type[ExampleSource]], type[ExampleSource]]:
    """Enter the source, as it is opened, as the saboteur of a check."""

    def enter(source: type[ExampleSource]) -> type[ExampleSource]:
        def start(self: Any) -> None:
            SourceUnderTest.__init__(self, source, "example:")

        spoils(check)(type(source.__name__, (SourceUnderTest,), {"__doc__": source.__doc__, "__init__": start}))
        return source

    return enter


@_spoils("check_source_info")
class Peeper(ExampleSource):
    """The test camera is one of the training cameras."""

    def __init__(self, uri: str, scale: float) -> None:
        super().__init__(uri, scale)
        self._info = replace(self.info, test=self.info.train.select([1]))

    def points(self, kind: str = "recording") -> PointCloud | None:
        return None


@_spoils("check_source_frames")
class Bytes(ExampleSource):
    """Images from 0 to 255."""

    stores_bytes = False

    def image(self, index: int, camera: str) -> np.ndarray:
        return super().image(index, camera) * np.float32(255)


@_spoils("check_source_repeatable")
class AutoExposure(ExampleSource):
    """Every opening has an exposure of its own."""

    stores_bytes = False
    openings = itertools.count(1)

    def __init__(self, uri: str, scale: float) -> None:
        super().__init__(uri, scale)
        self.gain = np.float32(1 / (1 + next(self.openings) % 7))

    def image(self, index: int, camera: str) -> np.ndarray:
        return super().image(index, camera) * self.gain


@_spoils("check_source_own_images")
class Hoarder(ExampleSource):
    """Gives everybody the one array that it keeps."""

    def __init__(self, uri: str, scale: float) -> None:
        super().__init__(uri, scale)
        self.kept: dict[tuple[int, str], Frame] = {}

    def frame(self, index: int, split: str = "train") -> Frame:
        if (index, split) not in self.kept:
            self.kept[index, split] = super().frame(index, split)
        return self.kept[index, split]


@_spoils("check_source_threads")
class OneReader(ExampleSource):
    """One reading position for everybody: who reads at the same time gets another's frame."""

    def frame(self, index: int, split: str = "train") -> Frame:
        self.place = index
        time.sleep(0.02)  # long enough for another thread to move the position
        return replace(super().frame(self.place, split), index=index, timestamp=index / self.info.fps)


@_spoils("check_source_goes_on")
class AtTheStart(ExampleSource):
    """Where a run goes on, all that was before is the first frame."""

    done = 0

    def go_on_at(self, index: int, past: Mapping[int, Moment]) -> None:
        self.done = index

    def frame(self, index: int, split: str = "train") -> Frame:
        return replace(super().frame(0 if 0 <= index < self.done else index, split), index=index)


@_spoils("check_source_bounds")
class FromTheEnd(ExampleSource):
    """Frame -1 is the last one, as in a list."""

    def frame(self, index: int, split: str = "train") -> Frame:
        return super().frame(index % 5 if index < 0 else index, split)


@_spoils("check_source_points")
class ByteColours(ExampleSource):
    """Colours of points from 0 to 255."""

    def points(self, kind: str = "recording") -> PointCloud | None:
        cloud = super().points(kind)
        assert cloud is not None
        return replace(cloud, rgb=cloud.rgb * np.float32(255))


@_spoils("check_source_scale")
class SameIntrinsics(ExampleSource):
    """Smaller images with the intrinsics of the large ones."""

    def __init__(self, uri: str, scale: float) -> None:
        super().__init__(uri, scale)
        train, test = (
            replace(rig, Ks=ExampleSource(uri, 1.0).info.train.Ks[: len(rig)])
            for rig in (self.info.train, self.info.test)
        )
        self._info = replace(self.info, train=train, test=test)


@_spoils("check_source_single_images")
class UpsideDown(ExampleSource):
    """Single images are upside down."""

    def image(self, index: int, camera: str) -> np.ndarray:
        return np.ascontiguousarray(super().image(index, camera)[:, ::-1])

    def frame(self, index: int, split: str = "train") -> Frame:
        frame = super().frame(index, split)
        return replace(frame, images=np.ascontiguousarray(frame.images[:, :, ::-1]))


@_spoils("check_source_stored_images")
class Rounder(ExampleSource):
    """Images are of no whole levels, and rounded where they are stored."""

    stores_bytes = False

    def image(self, index: int, camera: str) -> np.ndarray:
        return super().image(index, camera) * np.float32(0.9)

    def stored_image(self, index: int, camera: str) -> np.ndarray:
        return to_bytes(self.image(index, camera))


@_spoils("check_source_wrapped")
class Forgetful(ExampleSource):
    """Nobody took part in its points, and more of them are left without some cameras than there are with them."""

    def points_without(self, cameras: Sequence[str], kind: str = "recording") -> PointCloud | None:
        return self.points(kind) if cameras == self.info.test.ids else None
