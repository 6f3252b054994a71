"""What a person is told of frame 0: that it takes hours, and what it lacks; nobody should have to guess that."""

from __future__ import annotations

import itertools
import re
import time
import warnings

import pytest

from gsstream.core.signs import Signs
from gsstream.engine.run.progress import RunProgress


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
    with Signs(False, lambda: 1000 * (time.monotonic() - start)) as signs:
        signs.tell("looking for points", 3, 50)
        deadline = time.monotonic() + 60
        said = ""
        while said.count("\n") < 2 and time.monotonic() < deadline:
            time.sleep(0.05)
            said += capsys.readouterr().err
    assert re.fullmatch(r"(looking for points 3/50, [\d.]+ (seconds|minutes) on this one\n)+", said)
    with Signs(True, lambda: 1000 * time.monotonic()) as signs:
        signs.tell("looking for points", 3, 50)
        time.sleep(0.6)
    assert capsys.readouterr().err == ""
