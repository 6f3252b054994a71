"""A watched folder against a model: cameras appear, pause, die and come back, and END comes before or after.

The writer and the watcher share one clock that only the watcher's waits advance. More examples:
``GSSTREAM_TEST_EXAMPLES=2000 pytest tests/input/recordings/test_watch_model.py``.
"""

from __future__ import annotations

import json
import os
import tempfile
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsstream.core.errors import EndOfRecording, SourceError
from gsstream.input.recordings import watch
from gsstream.input.recordings.watch import WatchSource

NAMES, TEST = ("a", "b", "c"), "c"
#: The writer's period is 1 s; a camera is late by less than that, and is waited for longer.
GRACE, TIMEOUT = 2.5, 60.0
#: END of a capture that is finished before the run begins.
FINISHED = 50.0
EXAMPLES = int(os.environ.get("GSSTREAM_TEST_EXAMPLES", "0"))


@dataclass
class Writer:
    """Writes what is due whenever the watcher waits; also the clock, and the event that ends a wait."""

    folder: Path
    events: list[tuple[float, str, int]]  # time, camera or "END", number; ascending
    now: float = 0.0
    written: dict[str, list[int]] = field(default_factory=lambda: {name: [] for name in NAMES})

    def monotonic(self) -> float:
        return self.now

    def time(self) -> float:
        return self.now

    def is_set(self) -> bool:
        return False

    def wait(self, seconds: float) -> None:
        self.now += seconds
        while self.events and self.events[0][0] <= self.now:
            at, name, number = self.events.pop(0)
            path = self.folder / (name if name == "END" else f"{name}/{number}.png")
            path.write_text("x" if name == "END" else str(10 * number + NAMES.index(name)))
            os.utime(path, (at, at))


@dataclass(frozen=True)
class Capture:
    """What a writer does: the numbers of each camera, how late each image is, and when END comes; None: never."""

    numbers: dict[str, frozenset[int]]
    late: dict[tuple[str, int], float]
    end: float | None
    policy: str
    ready: str

    def events(self) -> list[tuple[float, str, int]]:
        images = [(t + self.late[name, t], name, t) for name in NAMES for t in self.numbers[name]]
        if self.end is None:
            return sorted(images)
        return [*sorted(event for event in images if event[0] < self.end), (self.end, "END", 0)]

    def expected(self) -> tuple[list[dict[str, int]], str]:
        """(per frame: camera -> number of the image shown; "" or why there is no frame at all)."""
        there = {name: {t for _, who, t in self.events() if who == name} for name in NAMES}
        every = sorted(set().union(*there.values()))
        if not every or any(every[0] not in numbers for numbers in there.values()):
            return [], "frame 0 needs every camera"
        shown: list[dict[str, int]] = []
        for t in every:
            if self.policy == "wait" and any(t not in numbers for numbers in there.values()):
                break
            shown.append({name: t if t in there[name] else shown[-1][name] for name in NAMES})
        return shown, ""


@st.composite
def captures(draw: st.DrawFn) -> Capture:
    numbers = {}
    first, step = draw(st.integers(0, 2)), draw(st.sampled_from([1, 1, 2]))
    possible = range(first, first + 8 * step, step)
    for name in NAMES:
        lacking = draw(st.sets(st.sampled_from(possible[1:]), max_size=5))
        last = draw(st.sampled_from([*possible, *[possible[-1]] * 8]))
        numbers[name] = frozenset(t for t in possible if t <= last and t not in lacking)
    late = {(name, t): draw(st.sampled_from([0.0, 0.0, 0.3, 0.8])) for name in NAMES for t in possible}
    end = draw(st.sampled_from([None, possible[-1] / 2, possible[-1] + 1.0, possible[-1] + 20.0, FINISHED]))
    return Capture(
        numbers=numbers,
        late=late,
        end=end,
        policy=draw(st.sampled_from(["wait", "hold", "drop"])),
        ready=draw(st.sampled_from(["stable", "rename"])),
    )


def folder_of(place: Path) -> Path:
    pose, K = np.eye(4).tolist(), [[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]]
    entries = []
    for name in NAMES:
        (place / name).mkdir()
        split = "test" if name == TEST else "train"
        entries.append(
            {"id": name, "split": split, "width": 1, "height": 1, "K": K, "w2c": pose, "frames": f"{name}/%d.png"}
        )
    (place / "cameras.json").write_text(json.dumps({"cameras": entries}))
    return place


def seen(capture: Capture, place: Path) -> tuple[list[dict[str, int]], list[float], str]:
    """What the watcher delivers: numbers of the images shown, what frames are worth, and how it ends."""
    writer = Writer(place, capture.events())
    writer.wait(2 * FINISHED if capture.end == FINISHED else 0.0)

    def read(path: Path, *_: Any) -> Any:
        return np.full((1, 1, 3), int(path.read_text()), np.uint8)

    options = f"missing={capture.policy}&grace={GRACE}&timeout={TIMEOUT}&poll=0.1&ready={capture.ready}"
    with mock.patch.object(watch, "time", writer), mock.patch.object(watch, "read_stored", read):
        live = WatchSource.from_query(f"{place}?{options}")
        live._stop = writer  # type: ignore[assignment]
        shown, worth = [], []
        while True:
            try:
                plan = live.moment(len(shown))
                images = {name: int(live.stored_image(len(shown), name)[0, 0, 0]) for name in NAMES}
            except EndOfRecording:
                return shown, worth, ""
            except SourceError as error:
                return shown, worth, str(error)
            assert all(images[name] % 10 == NAMES.index(name) for name in NAMES)
            shown.append({name: images[name] // 10 for name in NAMES})
            worth.append(plan.epoch_scale)
            assert len(shown) < 100


@given(captures())
@settings(max_examples=EXAMPLES or 80, deadline=None)
def test_a_watched_folder_gives_every_frame_that_any_camera_has(capture: Capture) -> None:
    expected, why = capture.expected()
    with tempfile.TemporaryDirectory() as place, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        shown, worth, told = seen(capture, folder_of(Path(place)))
    assert shown == expected
    assert (why in told) if why else not told
    for frame, value in zip(shown, worth, strict=True):
        complete = len({frame[name] for name in NAMES if name != TEST}) == 1
        newest = max(frame.values()) == frame["a"]
        if capture.policy == "drop":
            assert value == (1.0 if complete and newest else 0.0)
        else:
            assert value == 1.0


@pytest.mark.parametrize("policy", ["hold", "drop"])
def test_a_camera_that_pauses_after_end_ends_nothing(policy: str, tmp_path: Path) -> None:
    """Ten frames, of which one camera lacks four in a row, and END is there when the run begins."""
    numbers = {name: frozenset(range(10)) - (frozenset(range(2, 6)) if name == "b" else frozenset()) for name in NAMES}
    late = dict.fromkeys([(name, t) for name in NAMES for t in range(10)], 0.0)
    capture = Capture(numbers, late, FINISHED, policy=policy, ready="stable")
    shown, _, told = seen(capture, folder_of(tmp_path))
    assert [frame["a"] for frame in shown] == list(range(10))
    assert [frame["b"] for frame in shown] == [0, 1, 1, 1, 1, 1, 6, 7, 8, 9]
    assert told == ""


def behind(policy: str, options: str, place: Path) -> tuple[list[float], float]:
    """What frames are worth, and how long the watcher waited: a backlog of 200, of which a camera lacks a hundred."""
    numbers = {name: frozenset(range(200)) for name in NAMES} | {"b": frozenset({*range(50), *range(150, 200)})}
    writer = Writer(folder_of(place), sorted((t / 10, name, t) for name in NAMES for t in numbers[name]))
    writer.wait(100.0)
    black = np.zeros((1, 1, 3), np.uint8)
    with mock.patch.object(watch, "time", writer), mock.patch.object(watch, "read_stored", return_value=black):
        live = WatchSource.from_query(f"{place}?missing={policy}&grace=2&poll=0.01&ready=rename&{options}")
        live._stop = writer  # type: ignore[assignment]
        return [live.moment(index).epoch_scale for index in range(200)], writer.now - 100.0


@pytest.mark.parametrize("policy", ["hold", "drop"])
def test_a_run_that_is_behind_waits_for_nobody_who_is_gone(policy: str, tmp_path: Path) -> None:
    """The frames of a pause lie long ago: their grace is over, also where it is longer than the time between two."""
    worth, waited = behind(policy, "behind=block", tmp_path)
    assert worth == [1.0] * 50 + [1.0 if policy == "hold" else 0.0] * 100 + [1.0] * 50
    assert waited < 5.0, "only for the last ones, which nobody has passed yet"


@pytest.mark.parametrize("policy", ["hold", "drop"])
def test_a_camera_that_is_gone_keeps_no_run_from_dropping_frames(policy: str, tmp_path: Path) -> None:
    worth, waited = behind(policy, "behind=drop&queue=8", tmp_path)
    assert sum(worth) < 15
    assert worth[-1] == 1.0
    assert waited < 5.0
