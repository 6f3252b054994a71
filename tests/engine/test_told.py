"""What a run tells: of frame 0 and its hours, of its cameras, of its latency."""

from __future__ import annotations

import itertools
import json
import math
import re
import time
import warnings
from typing import Any

import numpy as np
import pytest
from rigs import inwards, looking, parallel

from gsstream.core.cameras import Cameras
from gsstream.core.frame import Arrival, Frame
from gsstream.core.progress import ProgressDisplay
from gsstream.discovery.catalog import load_catalog
from gsstream.encode import assemble, recipe_for
from gsstream.engine.run.few_cameras import AROUND, ONE_SIDE, expectation, first_frame_summary, widest_gap
from gsstream.engine.run.live import COUNTED, latency_lines, latency_words, live_metrics, past_moments
from gsstream.engine.run.progress import RunProgress
from gsstream.input.recordings.base import Moment


class Clock:
    """Seconds that pass only when they are told to."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


def told(
    capsys: pytest.CaptureFixture[str], pace: float, iterations: int, *, quiet: bool
) -> tuple[list[str], list[str]]:
    """(lines, warnings) of a frame 0 whose every iteration takes ``pace`` seconds."""
    clock = Clock()
    progress = RunProgress(1, quiet, clock)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for iteration in range(1, iterations + 1):
            clock.now += pace
            progress.first_frame(iteration, iterations, 0.1, 100)
    return capsys.readouterr().err.splitlines(), [str(warning.message) for warning in caught]


@pytest.mark.parametrize("quiet", [False, True])
def test_hours_are_announced_once_and_early(capsys, quiet) -> None:
    lines, announced = told(capsys, 9.0, 2000, quiet=quiet)
    assert announced == [
        "frame 0 takes about 5.0 hours more at this pace (3 of 2000 iterations are done). Smaller pictures (--scale) "
        "and fewer iterations (--set first_frame.max_iterations=N) make it shorter"
    ]
    assert bool(lines) != quiet


def test_lines_say_what_is_left_once_the_pace_is_known(capsys) -> None:
    lines, announced = told(capsys, 0.5, 400, quiet=False)
    assert announced == []
    assert lines[0] == "frame 0: iteration 8/400, loss 0.1000, 100 Gaussians, about 3.3 minutes left"
    assert lines[-1] == "frame 0: iteration 400/400, loss 0.1000, 100 Gaussians"
    left = [float(line.split("about ")[1].split()[0]) for line in lines[:-1] if "minutes" in line]
    assert left == sorted(left, reverse=True)
    assert any("seconds left" in line for line in lines)
    iterations = [int(re.search(r"iteration (\d+)", line)[1]) for line in lines]
    assert max(b - a for a, b in itertools.pairwise([0, *iterations])) * 0.5 <= 5, "a sign at least every 5 seconds"


def test_a_fast_frame_0_says_nothing_of_time(capsys) -> None:
    lines, announced = told(capsys, 0.001, 300, quiet=False)
    assert announced == []
    assert not any("left" in line for line in lines)


def test_work_that_says_nothing_is_shown_every_few_seconds(capsys: pytest.CaptureFixture[str]) -> None:
    """The clock runs a thousand times too fast; the thread that looks at it does not."""
    start = time.monotonic()
    with ProgressDisplay(False, lambda: 1000 * (time.monotonic() - start)) as display:
        display.tell("looking for points", 3, 50)
        deadline = time.monotonic() + 60
        said = ""
        while said.count("\n") < 2 and time.monotonic() < deadline:
            time.sleep(0.05)
            said += capsys.readouterr().err
    assert re.fullmatch(r"(looking for points 3/50, [\d.]+ (seconds|minutes) on this one\n)+", said)
    with ProgressDisplay(True, lambda: 1000 * time.monotonic()) as display:
        display.tell("looking for points", 3, 50)
        time.sleep(0.6)
    assert capsys.readouterr().err == ""


def test_work_in_which_nothing_changes_is_shown_ever_less_often(capsys: pytest.CaptureFixture[str]) -> None:
    """An hour of one step, looked at four times a second: a dozen lines, not nine hundred."""
    now = [0.0]
    with ProgressDisplay(False, lambda: now[0]) as display:
        display._over.set()  # the thread that looks at the clock has nothing to do here
        display.tell("checking the scene")
        printed = []
        for tick in range(4 * 3600):
            now[0] = tick / 4
            if display.due():
                display.say(display.line())
                printed.append(now[0])
        assert printed == [4.0 * 2**n for n in range(10)]
        display.tell("checking the scene: do the clocks agree?")
        assert display.due(), "something new is said at once, and then after four seconds again"
        display.say(display.line())
        now[0] += 4
        assert display.due()
    assert capsys.readouterr().err.count("\n") == 11


def line(cameras: Cameras, **settings: Any) -> str:
    given = {f"first_frame.{key}": value for key, value in settings.items()}
    parts = assemble(recipe_for("dense", given), load_catalog())
    return first_frame_summary(parts, cameras, "the recording")


@pytest.mark.parametrize(("count", "degrees", "step"), [(4, 360, 90), (8, 360, 45), (5, 60, 15), (2, 180, 180)])
def test_the_gap_is_that_between_neighbours(count: int, degrees: float, step: float) -> None:
    """The cameras stand on a circle of radius 3, 0.6 above what they look at."""
    cosine = (9 * math.cos(math.radians(step)) + 0.36) / 9.36
    assert widest_gap(inwards(count, degrees)) == pytest.approx(math.degrees(math.acos(cosine)), abs=0.2)


def test_one_camera_has_no_neighbour() -> None:
    assert widest_gap(looking([[1, 2, 3]], [[0, 0, 0]])) == 0


def test_few_or_distant_cameras_are_told_what_to_expect() -> None:
    four, arc = expectation(inwards(4, 360)), expectation(inwards(4, 60))
    assert four.startswith("4 training cameras, of which one is ")
    assert AROUND in four
    assert ONE_SIDE in arc
    assert "degrees" in expectation(inwards(7, 360)), "enough of them, but too far apart"
    assert expectation(looking([[1, 2, 3]], [[0, 0, 0]])).startswith("1 training camera: ")
    assert expectation(inwards(9, 360)) == ""
    assert expectation(inwards(6, 100)) == ""
    assert expectation(parallel(6)) == ""


def test_the_line_names_what_was_done_and_why() -> None:
    found = line(inwards(6, 360))
    for part in (
        "seeds: the recording",
        "the mean of its images",
        "256 large seeds",
        "dropout 0.2, because 6 cameras",
        "smoothness of depth 1, because 6 cameras around a room",
    ):
        assert part in found
    many = line(inwards(12, 360))
    assert "dropout" not in many
    assert "smoothness" not in many
    own = line(inwards(6, 360), few_cameras=False, shell=False)
    assert "dropout" not in own
    assert "smoothness" not in own
    assert "large seeds" not in own


RIG = Cameras(
    ("a", "b"), np.eye(4)[None].repeat(2, 0).astype(np.float32), np.eye(3)[None].repeat(2, 0).astype(np.float32), 8, 8
)


def entry(index: int, effort: float, arrival: Arrival | None, written: float = 12.0) -> dict | None:
    """As metrics.jsonl has it, through JSON."""
    frame = Frame(index, 0.0, np.zeros((2, 8, 8, 3), np.float32), RIG, effort, arrival)
    return json.loads(json.dumps(live_metrics(frame, written)))


def latency_line(index: int, latency: float | None, policy: str | None = None) -> dict:
    return {"frame": index, "live": {"latency_seconds": latency, "policy": policy, "epoch_scale": 1.0, "absent": []}}


@pytest.mark.parametrize(
    ("index", "effort", "absent", "policy"),
    [
        (3, 1.0, (), None),
        (3, 0.5, (), "hurried"),
        (3, 0.0, (), "dropped"),
        (3, 1.0, ("b",), "held"),
        (3, 0.5, ("b",), "hurried"),
        (3, 0.0, ("b",), "missing"),
        (0, 0.0, (), None),
        (0, 0.5, (), None),
    ],
)
def test_a_frame_has_one_policy_and_frame_0_none(
    index: int, effort: float, absent: tuple[str, ...], policy: str | None
) -> None:
    got = entry(index, effort, Arrival(10.5, absent, waiting=2))
    assert got == {
        "latency_seconds": 1.5,
        "policy": policy,
        "epoch_scale": effort,
        "absent": list(absent),
        "waiting": 2,
    }
    came = past_moments([{"frame": index, "live": got}])[index]
    assert came == Moment(effort, Arrival(None, absent, waiting=2)), "a run that goes on takes it for what it was"


def test_a_clock_that_is_ahead_shows_and_nothing_is_said_of_recordings_that_are_not_live() -> None:
    early, gone = entry(1, 1.0, Arrival(13.0)), entry(1, 1.0, Arrival(None))
    assert early is not None
    assert gone is not None
    assert (early["latency_seconds"], gone["latency_seconds"]) == (-1.0, None)
    assert latency_words({"live": gone}) == ["latency unknown"]
    assert entry(1, 1.0, None) is None
    assert (
        latency_words({"live": None})
        == latency_words({})
        == latency_lines([{"frame": 0}, {"frame": 1, "live": None}])
        == []
    )


def test_the_summary_leaves_dropped_frames_out_of_the_latency_and_counts_them() -> None:
    said = [
        (40.0, None), (4.0, None), (3.0, "hurried"), (90.0, "dropped"), (1.0, "held"), (80.0, "missing"), (2.0, None),
        (70.0, "dropped"),
    ]  # fmt: skip
    lines = [latency_line(index, *one) for index, one in enumerate(said)]
    assert latency_lines(lines) == [
        "latency from image to packet: frame 0 40.00 s; later frames: median 2.50 s, worst 4.00 s (frame 1)",
        "of 7 later frames: 2 dropped because the run was behind, 1 dropped because a camera's image did not come, "
        "1 hurried, 1 with held images",
        "frames dropped by a run that was behind are not measured above; gsstream evaluate measures all",
    ]
    assert latency_lines(lines[:1]) == ["latency from image to packet: frame 0 40.00 s"]
    assert latency_lines([latency_line(0, None), latency_line(1, None)])[0].endswith("unknown, the images were gone")
    assert latency_lines([latency_line(3, 0.5)]) == [
        "latency from image to packet: later frames: median 0.50 s, worst 0.50 s (frame 3)",
        "of 1 later frames: none was dropped, hurried or held",
    ], "a run of which only the end is at hand"


@pytest.mark.parametrize("policy", [None, *COUNTED])
def test_every_policy_has_words(policy: str | None) -> None:
    assert latency_words(latency_line(2, 0.256, policy))[0] == "0.26 s late"
    assert len(latency_words(latency_line(2, 0.256, policy))) == 1 + (policy is not None)
    assert len(latency_lines([latency_line(2, 0.2, policy)])) == 2 + (policy == "dropped")
