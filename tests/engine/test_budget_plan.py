"""Planning frames under a budget: units, the pure planner, and what is reported."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

from gsstream.core import log as log_module
from gsstream.core.errors import RecipeError
from gsstream.core.log import FrameLog
from gsstream.engine.budget.controller import Controller, spent
from gsstream.engine.budget.epoch_scheduler import estimated_bytes, next_rate_weight
from gsstream.engine.budget.plan import (
    MAX_WEIGHT,
    MIN_PART_SCALE,
    MIN_WEIGHT,
    TIME_MARGIN,
    Past,
    epochs_in,
    plan,
)
from gsstream.engine.budget.report import budget_lines
from gsstream.method.base import Step
from gsstream.method.budget import FrameBudget
from gsstream.packet import encode_empty
from gsstream.packet.symbols import encode_symbols
from gsstream.recipe.budget import Budget, budget_overrides
from gsstream.recipe.model import Stream

SECONDS = st.floats(1e-3, 10)
PASTS = st.builds(
    Past,
    frame=st.just(1),
    epochs=st.floats(0.1, 30),
    candidates=st.integers(1, 10_000),
    before=SECONDS,
    optimise=SECONDS,
    after=SECONDS,
    weight=st.floats(MIN_WEIGHT, MAX_WEIGHT),
    step_scale=st.floats(1, 4),
    threshold=st.floats(0, 24),
    estimate=st.floats(0, 1e5),
    untrimmed=st.integers(16, 100_000),
    size=st.integers(16, 100_000),
)
HISTORIES = st.lists(PASTS, max_size=8)
STREAMS = st.builds(Stream, epochs=st.integers(1, 30), change_threshold=st.sampled_from([0.0, 6.0]))
USUAL = Past(1, 20.0, 1000, 0.1, 1.0, 0.1, 3e-4, 1.0, 6.0, 9000.0, 9900, 9500)


@pytest.mark.parametrize(
    ("text", "seconds"), [("1.0s", 1.0), ("800ms", 0.8), ("2 min", 120.0), (".5s", 0.5), ("1e-1s", 0.1), (3, 3.0)]
)
def test_times(text: object, seconds: float) -> None:
    assert Budget.model_validate({"time": text}).time == pytest.approx(seconds)


@pytest.mark.parametrize(
    ("text", "size"),
    [("20KB", 20_000), ("1.5 MB", 1_500_000), ("500B", 500), ("999 bytes", 999), ("2GB", 2 * 10**9), (77, 77)],
)
def test_sizes_are_decimal(text: object, size: int) -> None:
    assert Budget.model_validate({"size": text}).size == size


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ({"size": "20kb"}, "no unit 'kb' here; did you mean 'KB'"),
        ({"size": "20KiB"}, "no unit 'KiB' here; did you mean 'KB'"),
        ({"time": "1sec"}, "no unit 'sec' here; did you mean 's'"),
        ({"time": "20KB"}, "no unit 'KB' here; units here: min, ms, s"),
        ({"time": "soon"}, "expected a number and a unit (s, ms, min), e.g. 1.5s"),
        ({"size": "3B"}, "greater than or equal to 16"),
        ({"time": "0s"}, "greater than 0"),
        ({"time": "-1s"}, "greater than 0"),
        ({"time": "1e999s"}, "expected a finite quantity"),
        ({"memory": True}, "valid integer"),
    ],
)
def test_nonsense_is_refused(given: dict[str, object], problem: str) -> None:
    with pytest.raises(ValueError, match=r".") as caught:
        Budget.model_validate(given, strict=True)
    assert problem in str(caught.value)


def test_command_line() -> None:
    wanted = [("--budget", "budget.time=1.0s"), ("--budget", "budget.size=20KB")]
    assert budget_overrides("time=1.0s, size=20KB") == wanted
    with pytest.raises(RecipeError, match="unknown key 'siz'; did you mean 'size'"):
        budget_overrides("siz=20KB")
    with pytest.raises(RecipeError, match="time is given twice"):
        budget_overrides("time=1s,time=2s")
    for text in ("", "time", "time=", "=3s", "size=1KB,"):
        with pytest.raises(RecipeError, match=r"expected KEY=QUANTITY, e\.g\."):
            budget_overrides(text)


@given(STREAMS, HISTORIES, st.floats(0.01, 100))
def test_never_above_the_time_when_the_floor_fits(stream: Stream, history: list[Past], seconds: float) -> None:
    found = plan(Budget(time=seconds), stream, history)
    assert 1 <= found.epochs <= max(stream.epochs, 30)
    if found.each is None:
        assert not history
        return
    assert found.predicted_seconds is not None
    around = found.predicted_seconds - found.epochs * found.each
    assume(around + found.each <= TIME_MARGIN * seconds)
    assert found.predicted_seconds <= seconds


@given(STREAMS, HISTORIES, st.floats(0.01, 100), st.floats(1, 10))
def test_more_time_is_never_fewer_passes(stream: Stream, history: list[Past], seconds: float, more: float) -> None:
    less, greater = (plan(Budget(time=s), stream, history).epochs for s in (seconds, more * seconds))
    assert greater >= less


@given(STREAMS, HISTORIES, st.integers(16, 10**6))
def test_a_size_plans_within_it_and_leaves_time_alone(stream: Stream, history: list[Past], size: int) -> None:
    found = plan(Budget(size=size), stream, history)
    assert found.max_bytes == size
    assert found.predicted_bytes is None or found.predicted_bytes <= size
    assert MIN_WEIGHT <= found.rd_lambda <= MAX_WEIGHT
    assert 1 <= found.step_scale <= 4
    assert found.epochs == stream.epochs, "bytes must not depend on what the clock said"
    assert found.change_threshold == stream.change_threshold
    slower = plan(Budget(size=size), stream, [replace(p, before=1.0, after=2.0, optimise=3.0) for p in history])
    timeless = {"after": 0.0, "each": None, "predicted_seconds": None}
    assert replace(found, **timeless) == replace(slower, **timeless)


@given(STREAMS, HISTORIES)
def test_without_limits_the_recipe_is_the_plan(stream: Stream, history: list[Past]) -> None:
    found = plan(Budget(), stream, history)
    assert (found.epochs, found.change_threshold, found.rd_lambda) == (
        stream.epochs,
        stream.change_threshold,
        stream.rd_lambda,
    )
    assert (found.step_scale, found.max_bytes, found.seconds) == (1.0, None, None)


def test_too_few_passes_raise_the_threshold_and_plenty_lower_it_again() -> None:
    stream, tight = Stream(change_threshold=6.0), Budget(time=1.0)
    poor = replace(USUAL, epochs=2.0)
    assert plan(tight, stream, [poor, poor]).change_threshold == 9.0
    assert plan(tight, stream, [USUAL, poor]).change_threshold == 6.0, "one slow frame is none"
    assert plan(tight, stream, [USUAL, poor, poor]).change_threshold == 9.0, "the last two count"
    assert plan(tight, stream, [poor, USUAL, poor]).change_threshold == 6.0
    assert plan(tight, stream, [poor, replace(poor, threshold=20.0)]).change_threshold == 24.0
    assert plan(tight, stream, [replace(USUAL, threshold=12.0)]).change_threshold == pytest.approx(9.6)
    assert plan(tight, stream, [USUAL]).change_threshold == 6.0
    assert plan(tight, Stream(), [poor, replace(poor, threshold=0.0)]).change_threshold == 3.0


@pytest.mark.parametrize(("limit", "scale"), [(4.0, 1.0), (1.0, (TIME_MARGIN - 0.2) / 2), (0.1, MIN_PART_SCALE)])
def test_where_no_residual_is_learned_motion_and_growth_make_the_passes_that_fit(limit: float, scale: float) -> None:
    """Their whole passes take two seconds, all else 0.2; two frames before made them all, the last a half of them."""
    whole = replace(USUAL, epochs=0.0, optimise=0.0, before=1.7, after=0.5, parts=2.0)
    half = replace(whole, before=0.9, after=0.3, parts=1.0, part_scale=0.5)
    budget, stream = Budget(time=limit), Stream(change_threshold=6.0)
    found = plan(budget, stream, [USUAL, whole, whole, half])
    assert found.part_scale == pytest.approx(scale)
    assert found.change_threshold == 6.0, "there were no passes of a residual that could have been too few"
    assert plan(budget, stream, [USUAL]).part_scale == 1.0
    assert plan(Budget(size=4000), stream, [whole]).part_scale == 1.0


def test_steps_get_coarser_only_when_the_weight_is_spent() -> None:
    stream, small = Stream(rd_lambda=3e-4), Budget(size=1000)
    spent = replace(USUAL, weight=MAX_WEIGHT, untrimmed=3000, size=1000)
    assert plan(small, stream, [spent]).step_scale == pytest.approx(math.sqrt(2))
    assert plan(small, stream, [replace(spent, weight=1e-3)]).step_scale == 1.0
    assert plan(small, stream, [replace(USUAL, step_scale=2.0)]).step_scale == pytest.approx(math.sqrt(2))


@given(st.floats(0, 100), st.floats(1e-6, 10), st.integers(1, 40))
def test_passes_fill_the_time(seconds: float, each: float, most: int) -> None:
    epochs = epochs_in(seconds, each, most)
    assert 1 <= epochs <= most
    assert epochs == 1 or epochs * each <= seconds * (1 + 1e-6)
    assert epochs == most or (epochs + 1) * each > seconds * (1 - 1e-6)


@given(st.floats(MIN_WEIGHT, MAX_WEIGHT), st.floats(0, 1e6), st.floats(1, 1e6))
def test_the_weight_moves_towards_the_size(weight: float, expected: float, wanted: float) -> None:
    after = next_rate_weight(weight, expected, wanted)
    assert MIN_WEIGHT <= after <= MAX_WEIGHT
    assert after >= weight if expected > wanted else after <= weight


def test_estimated_bytes() -> None:
    torch.manual_seed(0)
    assert estimated_bytes(torch.zeros(0, 5)) == 0.0
    fair = torch.randint(0, 4, (8000, 3)).float()
    assert estimated_bytes(fair) == pytest.approx(3 * 8000 * 2 / 8, rel=0.02)
    assert estimated_bytes(torch.zeros(1000, 3)) < 40


@pytest.mark.parametrize("spread", [0.5, 3.0, 40.0])
@pytest.mark.parametrize("rows", [5, 50, 5000])
def test_estimated_bytes_are_hardly_less_and_little_more_than_those_of_the_coder(rows: int, spread: float) -> None:
    """Few rows of many values cost mostly the model: which values there are, and how many of each."""
    symbols = np.rint(np.random.default_rng(0).laplace(scale=spread, size=(rows, 6))).astype(np.int32)
    coded = len(encode_symbols(symbols))
    assert 0.99 * coded <= estimated_bytes(torch.from_numpy(symbols)) <= 1.05 * coded + 100


class Clock:
    """A clock that is set by hand, and frames whose logs run by it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.seconds = 0.0
        monkeypatch.setattr(log_module.time, "perf_counter", lambda: self.seconds)

    def settled(self, controller: Controller, frame: int, size: int, seconds: float, first: bool = False) -> FrameLog:
        """Return the log of a frame of so many bytes and seconds, after the controller has settled it."""
        log = FrameLog()
        allowed = controller.allow(log, first)
        log.set(bytes={"all": size}, num_gaussians=10, candidate_gaussians=5)
        with log.phase("code"):
            self.seconds += seconds
        packet = replace(encode_empty(frame=frame), data=bytes(size))
        controller.settle(Step(None, packet, "key" if first else "delta"), allowed, 3, log)
        return log


def test_violations_are_written_down_and_summed_up(monkeypatch: pytest.MonkeyPatch) -> None:
    controller, clock = Controller(Budget(size=1000, time=2.0), Stream()), Clock(monkeypatch)
    logs = [clock.settled(controller, 0, 99_000, 90.0, first=True)]
    logs += [clock.settled(controller, t, 990 + 10 * t, 1.5 + 0.5 * (t == 3)) for t in range(1, 4)]
    lines = [{"frame": frame, **log.entry()} for frame, log in enumerate(logs)]
    assert [entry["budget"]["violated"] for entry in lines] == [[], [], ["size"], ["size"]]
    assert lines[0]["budget"]["limits"] == {}, "frame 0 is what a budget starts from"
    text = "\n".join(budget_lines(lines))
    assert "budget size 1.00 KB: 1 of 3 frames inside; median 1.01 KB, most 1.02 KB" in text
    assert "budget time 2.00 s: 3 of 3 frames inside" in text
    assert "outside the budget:\n  frame 2: size 1.01 KB of 1.00 KB\n  frame 3: size 1.02 KB of 1.00 KB" in text
    assert budget_lines([{"frame": 0}]) == []


def test_the_first_frame_has_no_limit_whatever_its_index(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stream may begin in the middle of a recording."""
    controller, clock = Controller(Budget(size=1000, time=2.0), Stream()), Clock(monkeypatch)
    first = clock.settled(controller, 5, 99_000, 90.0, first=True).numbers["budget"]
    assert (first["limits"], first["violated"]) == ({}, [])
    assert clock.settled(controller, 6, 1001, 1.0).numbers["budget"]["violated"] == ["size"]


def test_fewer_passes_of_motion_and_growth_are_written_down_and_summed_up() -> None:
    planned = FrameBudget(epochs=1, change_threshold=0.0, rd_lambda=0.0, seconds=1.0, part_scale=0.4)
    used = {
        "rd_lambda": 0.0, "estimate": 0.0, "stopped_by_clock": True, "untrimmed": 9, "dropped": {}, "before": 0.5,
        "optimise": 0.0, "parts": 0.8,
    }  # fmt: skip
    entry = spent(planned, used, Stream(epochs=1), 1.0)
    assert entry["reduced"] == {"part_scale": 0.4}
    assert entry["binding"] == ["time"], "once, though the clock stopped the passes of the residual, too"
    line = {"frame": 1, "budget": {**entry, "limits": {"time": 1.0}, "actual": {"time": 0.9}, "violated": []}}
    assert "given up: 0.40 of the passes of motion and growth (median of 1 frames)" in budget_lines([line])


def test_a_key_packet_waits_until_it_can_be_paid(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock(monkeypatch)

    def refusal(controller: Controller, number: int) -> str | None:
        return controller.key_refusal(controller.allow(FrameLog()), number)

    controller = Controller(Budget(size=1000), Stream())
    assert refusal(controller, 10) is None, "nothing is known yet"
    clock.settled(controller, 0, 5000, 1.0, first=True)
    assert refusal(controller, 10) == "about 5000 bytes where 1000 are allowed"
    assert refusal(controller, 1) is None
    slow = Controller(Budget(time=0.5), Stream())
    clock.settled(slow, 0, 5000, 1.0, first=True)
    assert "where 0.5 s are allowed" in str(refusal(slow, 10))


@pytest.mark.parametrize("logged", [False, True])
def test_a_method_that_logs_no_use_of_its_budget_is_described_by_its_phases(
    logged: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    controller, clock, log = Controller(Budget(size=1000, time=9.0), Stream()), Clock(monkeypatch), FrameLog()
    budget = controller.allow(log)
    for phase, seconds in (("motion", 1.0), ("optimise", 4.0), ("code", 0.5)):
        with log.phase(phase):
            clock.seconds += seconds
    if logged:
        log.set(iterations=6)
    packet = encode_empty(frame=1)
    log.set(bytes={"header": len(packet.data)}, num_gaussians=10)
    controller.settle(Step(None, packet, "empty"), budget, 3, log)
    assert ("usage" in log.numbers["budget"]) == logged, "a frame without iterations says nothing of what epochs cost"
    if logged:
        usage = log.numbers["budget"]["usage"]
        assert (usage["epochs"], usage["seconds_before"], usage["seconds_optimise"]) == (2, 1.0, 4.0)
        assert usage["untrimmed_bytes"] == len(packet.data)


def test_a_frame_starts_with_the_recipes_weight_or_less_where_bytes_were_left() -> None:
    stream, size = Stream(rd_lambda=3e-4), Budget(size=10_000)
    assert plan(size, stream, []).rd_lambda == 3e-4
    known = replace(USUAL, weight=2e-4)
    starts = [plan(size, stream, [replace(known, untrimmed=n)]).rd_lambda for n in (3000, 9400, 13_000, 99_000)]
    assert starts == sorted(starts)
    assert starts[0] == 1e-4
    assert starts[1] == pytest.approx(2e-4, rel=1e-3)
    assert starts[2:] == [3e-4, 3e-4]
