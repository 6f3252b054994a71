"""The record of a frame, and images as bytes."""

from __future__ import annotations

import numpy as np
import pytest

from gsstream.core import log as module
from gsstream.core.log import PHASES, FrameLog
from gsstream.core.storage import packed, unpacked


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


@pytest.mark.parametrize("size", [(3, 4, 3), (2, 130, 130, 3)])
def test_images_wait_as_bytes_where_they_say_the_same_and_else_leaves_images_alone(size: tuple[int, ...]) -> None:
    images = np.random.default_rng(0).integers(0, 256, size) / np.float32(255)
    images = images.astype(np.float32)
    stored = packed(images)
    assert stored.dtype == np.uint8
    assert unpacked(stored).tobytes() == images.tobytes()
    for last in (np.nan, np.inf, -1 / 255, 256 / 255, 300 / 255, 0.5, np.nextafter(images.flat[-1], np.float32(2))):
        images.flat[-1] = last
        assert packed(images) is images
