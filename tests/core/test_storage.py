"""Images as bytes: what is lost, what is not, and that nothing is hidden."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gsstream.core.errors import ShapeError
from gsstream.core.storage import packed, rounded, unpacked
from gsstream.input.recordings.disturbed import DisturbedSource
from gsstream.input.recordings.options import DataOptions, Disturbances
from gsstream.input.recordings.prefetch import Prefetcher
from gsstream.input.recordings.synthetic import SyntheticSource
from gsstream.input.recordings.transformed import transformed

UNIT = arrays(np.float32, (5, 3), elements=st.floats(0, 1, width=32))
ERROR = {"float32": 0.0, "uint8": 1 / 510 + 1e-7}


@pytest.mark.parametrize("storage", ERROR)
@given(images=UNIT)
def test_the_error_is_bounded_and_twice_is_once(storage, images: np.ndarray) -> None:
    once = rounded(images, storage)
    assert once.dtype == np.float32
    assert np.abs(once - images).max() <= ERROR[storage]
    assert rounded(once, storage).tobytes() == once.tobytes()
    assert packed(images, storage).itemsize == np.dtype(storage).itemsize


def test_bytes_keep_what_was_recorded_in_8_bits() -> None:
    levels = np.arange(256, dtype=np.float32) / np.float32(255)
    assert rounded(levels, "uint8").tobytes() == levels.tobytes()


@pytest.mark.parametrize("size", [(3, 4, 3), (2, 130, 130, 3)])
def test_auto_stores_bytes_where_they_say_the_same_and_else_leaves_images_alone(size: tuple[int, ...]) -> None:
    images = np.random.default_rng(0).integers(0, 256, size) / np.float32(255)
    images = images.astype(np.float32)
    stored = packed(images, "auto")
    assert stored.dtype == np.uint8
    assert unpacked(stored).tobytes() == images.tobytes()
    for last in (np.nan, np.inf, -1 / 255, 256 / 255, 300 / 255, 0.5, np.nextafter(images.flat[-1], np.float32(2))):
        images.flat[-1] = last
        assert packed(images, "auto") is images
        assert rounded(images, "auto") is images


@pytest.mark.parametrize("wrong", [float("nan"), float("inf"), -0.01, 1.01])
def test_what_bytes_cannot_hold_is_refused(wrong: float) -> None:
    images = np.full((1, 2, 2, 3), 0.5, np.float32)
    images[0, 1, 0, 2] = wrong
    with pytest.raises(ShapeError, match="expected values from 0 to 1 to store as uint8"):
        packed(images, "uint8")


def test_frames_wait_packed_and_come_as_the_source_gives_them() -> None:
    """What is decoded ahead has the values that a resumed run reads; test images are not touched."""
    recording = SyntheticSource.from_query("frames=5&views=2&width=24&height=16")
    plain = DisturbedSource(recording, Disturbances(gain=0.9), 0, "world")  # no longer 8 bits
    source = transformed(plain, DataOptions(images="uint8"))
    with Prefetcher(source, range(5), storage="uint8") as frames:
        waiting = frames._pending[0].result()
        assert waiting[0].images.dtype == np.dtype("uint8")
        for index, (train, test) in zip(itertools.count(), frames, strict=False):
            assert train.images.dtype == np.dtype("uint8")
            floats = train.as_float32().images
            assert floats.tobytes() == source.frame(index).images.tobytes()
            assert floats[1].tobytes() == train.image(1).tobytes()
            assert 0 < np.abs(floats - plain.frame(index).images).max() <= ERROR["uint8"]
            assert test.images.tobytes() == plain.frame(index, "test").images.tobytes()
