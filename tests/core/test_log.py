"""The record of a frame, and images as bytes."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gsstream.core import log as module
from gsstream.core.errors import ShapeError
from gsstream.core.log import PHASES, FrameLog
from gsstream.core.storage import packed, rounded, unpacked
from gsstream.input.recordings.disturbed import DisturbedSource
from gsstream.input.recordings.options import DataOptions, Disturbances
from gsstream.input.recordings.prefetch import Prefetcher
from gsstream.input.recordings.synthetic import SyntheticSource
from gsstream.input.recordings.transformed import transformed


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Return a clock that is set by hand."""
    hand = [0.0]
    monkeypatch.setattr(module.time, "perf_counter", lambda: hand[0])
    return hand


def test_phases_add_up_to_the_time_since_the_log_was_made(clock: list[float]) -> None:
    log = FrameLog()
    clock[0] += 1
    with log.phase("motion"):
        clock[0] += 2
        with log.phase("motion/anchors"):
            clock[0] += 4
        with log.phase("code"):
            clock[0] += 8
    with log.phase("change"):
        clock[0] += 16
    with log.phase("motion"):
        clock[0] += 32
    clock[0] += 64
    seconds = log.entry()["seconds"]
    assert seconds == {"change": 16, "motion": 34, "motion/anchors": 4, "code": 8, "other": 65}
    assert list(seconds) == ["change", "motion", "motion/anchors", "code", "other"]
    assert sum(seconds.values()) == log.elapsed() == 127
    assert log.seconds("motion", "code") == 46


def test_a_phase_that_raises_is_counted(clock: list[float]) -> None:
    log = FrameLog()

    def fail() -> None:
        with log.phase("growth"):
            clock[0] += 3
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert log.entry()["seconds"] == {"growth": 3, "other": 0}


def test_the_later_number_wins_and_counters_add() -> None:
    log = FrameLog()
    log.set(bytes={"gates": 3}, loss=0.5)
    log.add(iterations=4)
    log.add(iterations=2)
    log.set(bytes={"means": 1})
    assert {**log.numbers} == {"bytes": {"means": 1}, "loss": 0.5, "iterations": 6}


def test_an_attempt_that_failed_keeps_its_time_alone(clock: list[float]) -> None:
    log = FrameLog()
    with log.phase("change"):
        clock[0] += 2
    log.set(changed_tiles=0.5)
    mark = log.mark()
    with log.phase("optimise"):
        clock[0] += 5
    clock[0] += 1
    log.set(loss=0.25)
    log.give_up(ValueError("no loss"), mark)
    with log.phase("code"):
        clock[0] += 1
    seconds = {"change": 2, "code": 1, "failed": 6, "other": 0}
    assert log.entry() == {"changed_tiles": 0.5, "error": "no loss", "seconds": seconds}


@pytest.mark.parametrize("name", ["", "Motion", "anchors", "follow_up", "/motion"])
def test_a_phase_of_another_name_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="expected one of seed, change, motion"), FrameLog().phase(name):
        pass
    assert "motion" in PHASES


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
