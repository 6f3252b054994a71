"""The prefetcher: order, bound, the place of errors, and threads that end."""

from __future__ import annotations

import itertools
import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gsstream.core.errors import InputError, SourceError
from gsstream.core.frame import Frame
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.base import Source, SourceInfo, Split, assembled
from gsstream.input.recordings.canonical import CanonicalSource, recording_similarity
from gsstream.input.recordings.options import DataOptions
from gsstream.input.recordings.prefetch import Prefetcher
from gsstream.input.recordings.synthetic import SyntheticSource
from gsstream.input.recordings.transformed import transformed

SPLITS: tuple[Split, ...] = ("train", "test")


class Watched(Source):
    """A real source that records which frames were asked for, and fails at one of them."""

    def __init__(self, faulty: int | None = None) -> None:
        self._source = SyntheticSource.from_query("frames=1000&views=2&width=8&height=8&supersample=1")
        self._faulty = faulty
        self.asked: list[int] = []

    @property
    def info(self) -> SourceInfo:
        return self._source.info

    def frame(self, index: int, split: Split = "train") -> Frame:
        if split == "train":
            self.asked.append(index)
        if index == self._faulty:
            raise SourceError(f"frame {index} is damaged")
        return self._source.frame(index, split)

    def close(self) -> None:
        self._source.close()


def prefetch_threads() -> list[threading.Thread]:
    return [t for t in threading.enumerate() if t.name.startswith("gsstream-prefetch")]


@pytest.mark.parametrize(("depth", "workers"), [(1, 1), (3, 2), (8, 4)])
def test_order_content_and_bound(depth: int, workers: int) -> None:
    source = Watched()
    with Prefetcher(source, itertools.count(2, 3), depth=depth, workers=workers) as frames:
        for step, (train, test) in zip(range(6), frames, strict=False):
            assert (train.index, test.index) == (2 + 3 * step, 2 + 3 * step)
            np.testing.assert_array_equal(train.images, source._source.frame(train.index).images)
            assert len(source.asked) <= step + 1 + depth
        assert step == 5, "six pairs are delivered"
    assert prefetch_threads() == []


@pytest.mark.parametrize(("width", "ahead"), [(8, 2), (2000, 1)])
def test_of_large_pictures_only_one_frame_is_read_ahead(width: int, ahead: int) -> None:
    class Wide(Watched):
        @property
        def info(self) -> SourceInfo:
            found = self._source.info
            return replace(found, train=found.train.scaled(width, width))

    frames = Prefetcher(Wide(), range(10))
    assert len(frames._pending) == ahead
    frames.close()


def test_an_error_surfaces_at_its_frame_and_ends_the_iteration() -> None:
    frames = Prefetcher(Watched(faulty=3), range(10), depth=6, workers=3)
    assert [next(frames)[0].index for _ in range(3)] == [0, 1, 2]
    with pytest.raises(SourceError, match="frame 3 is damaged"):
        next(frames)
    assert list(frames) == []
    assert prefetch_threads() == []


def test_the_end_is_reached_once_and_close_may_be_repeated() -> None:
    frames = Prefetcher(Watched(), range(3), depth=5)
    assert [pair[0].index for pair in frames] == [0, 1, 2]
    frames.close()
    frames.close()
    assert list(frames) == []
    assert list(Prefetcher(Watched(), [])) == []


def test_closing_early_asks_for_nothing_more() -> None:
    source = Watched()
    frames = Prefetcher(source, range(1000), depth=2)
    next(frames)
    frames.close()
    asked = len(source.asked)
    assert asked <= 4
    assert list(frames) == []
    assert len(source.asked) == asked
    assert prefetch_threads() == []


@pytest.mark.parametrize(("depth", "workers"), [(0, 1), (1, 0)])
def test_bounds_below_one_are_refused(depth: int, workers: int) -> None:
    with pytest.raises(InputError, match="must be at least 1"):
        Prefetcher(Watched(), range(3), depth=depth, workers=workers)


class Singly(Source):
    """A recording of 8 bits that counts how it is read; ``shift`` takes its last camera off the levels of bytes."""

    def __init__(self, shift: float = 0.0) -> None:
        self._inner, self.wholes, self.singles = SyntheticSource.from_query("frames=3&views=3&width=24&height=16"), 0, 0
        self._shift = shift

    @property
    def info(self) -> SourceInfo:
        return self._inner.info

    def frame(self, index: int, split: Split = "train") -> Frame:
        self.wholes += split == "train"
        return assembled(self, index, split).as_float32()

    def image(self, index: int, camera: str) -> FloatArray:
        self.singles += camera in self.info.train.ids
        shift = np.float32(self._shift if camera == self.info.train.ids[-1] else 0)
        return self._inner.image(index, camera) + shift

    def stored_frame(self, index: int, split: Split = "train") -> Frame:
        return assembled(self, index, split)


@pytest.mark.parametrize(("shift", "dtype"), [(0.0, np.uint8), (1e-3, np.float32)])
def test_images_wait_as_bytes_where_bytes_hold_all_of_them(shift: float, dtype: type) -> None:
    """Either way the frame is the one that the source gives, and each image is read once."""
    source, plain = Singly(shift), Singly(shift)
    with Prefetcher(source, range(3), pack=True) as frames:
        for index, (train, test) in enumerate(frames):
            want = plain.frame(index)
            assert train.images.dtype == dtype
            assert train.as_float32().images.tobytes() == want.images.tobytes()
            assert (train.index, train.timestamp, train.cameras.ids) == (index, want.timestamp, want.cameras.ids)
            assert test.as_float32().images.tobytes() == plain.frame(index, "test").images.tobytes()
    assert (source.wholes, source.singles) == (0, 9)


class Stored(Singly):
    """The same, of which the images can be read as the bytes that they are."""

    def stored_image(self, index: int, camera: str) -> Any:
        return np.rint(Singly.image(self, index, camera) * 255).astype(np.uint8)

    def image(self, index: int, camera: str) -> FloatArray:
        raise AssertionError("read as float32, though its bytes are offered")


def as_runs_open_it(source: Source, **options: Any) -> Source:
    return CanonicalSource(transformed(source, DataOptions(**options)), recording_similarity(source))


@pytest.mark.parametrize(
    "options", [{}, {"test_cameras": ("cam00",)}, {"split": "tuning"}, {"train_views": 2}, {"bad_image": "drop"}]
)
def test_what_is_stored_as_bytes_is_never_float32_whatever_wraps_it(options: dict[str, Any]) -> None:
    source, plain = as_runs_open_it(Stored(), **options), as_runs_open_it(Singly(), **options)
    with Prefetcher(source, range(3), pack=True) as frames:
        for index, pair in enumerate(frames):
            for frame, split in zip(pair, SPLITS, strict=True):
                assert frame.images.dtype == np.uint8
                assert frame.as_float32().images.tobytes() == plain.frame(index, split).images.tobytes()
