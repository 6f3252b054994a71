"""The pace inside a frame, on a clock that the test moves: passes follow what passes take, and nothing is late."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from gsstream.engine.budget.epoch_scheduler import EpochScheduler
from gsstream.engine.budget.plan import MAX_TRIMMED, TIME_MARGIN, UNKNOWN_RESERVE, Past, plan, unlimited
from gsstream.method.budget import FrameBudget
from gsstream.recipe.budget import Budget
from gsstream.recipe.model import Stream


class Clock:
    """A clock that a test moves."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


VIEWS = 5


def paced(
    seconds: float, effort: float = 1.0, before: float = 0.0, now: int = 10, **known: float
) -> tuple[EpochScheduler, Clock]:
    clock = Clock()
    began = clock.now
    clock.now += before
    values = {"after": 1.0, "each": 0.55, **known}
    budget = FrameBudget(20, 6.0, 3e-4, max_epochs=30, seconds=seconds, started=began, clock=clock, **values)  # type: ignore[arg-type]
    return EpochScheduler(budget, VIEWS, now, effort), clock


def views_made(pace: EpochScheduler, clock: Clock, *seconds: float) -> int:
    """How many views a frame makes whose views take so many seconds, the last of them from then on."""
    made = 0
    while pace.goes_on:
        for piece in pace.next_pass(range(VIEWS)):
            assert len(piece) == 1, "the clock is read after every view"
            clock.now += seconds[min(made, len(seconds) - 1)]
            made += 1
    return made


def test_the_clock_ends_a_frame_before_its_coding_has_no_time_left() -> None:
    pace, clock = paced(5.0)
    assert views_made(pace, clock, 0.3) == 13, "4 seconds are there beside coding, and 13 views of 0.3 s fit into them"
    assert pace.stopped_by_clock
    assert pace.is_cut
    assert pace.done == 2, "the third pass was not made to its end"
    assert pace.optimise == pytest.approx(13 * 0.3)


@pytest.mark.parametrize(("effort", "views"), [(1.0, 33), (0.5, 16), (0.2, 6), (0.01, 1)])
def test_a_hurried_frame_takes_its_share_of_the_time_that_passes_have(effort: float, views: int) -> None:
    """Its run is behind: time that the deadline leaves is for the frames that wait."""
    pace, clock = paced(13.0, effort, before=2.0)
    assert views_made(pace, clock, 0.3) == views, "of 13 seconds 2 were before the passes and 1 is kept for the rest"


def test_a_hurried_frame_that_has_no_time_left_is_not_given_more() -> None:
    pace, clock = paced(2.0, 0.2, before=5.0)
    assert views_made(pace, clock, 0.3) == 1


def test_passes_follow_what_they_took() -> None:
    pace, clock = paced(11.0)
    assert pace.epochs == 18, "10 s, 0.55 s a pass in the frames before"
    for done, seconds, planned in ((1, 2.0, 5), (2, 1.0, 9), (3, 5.74, 3)):
        for _ in pace.next_pass(range(VIEWS)):
            clock.now += seconds / VIEWS
        assert pace.done == done
        assert pace.epochs == planned, "what is left, at what the last pass took"
    assert pace.stopped_by_clock, "a view would fit into what is left, and a quarter of a pass would not"
    assert not pace.goes_on


def test_the_first_number_of_passes_scales_with_the_candidates() -> None:
    assert [paced(11.0, now=now, each=1.0, candidates=100)[0].epochs for now in (100, 400)] == [10, 3]


def test_without_a_limit_nothing_changes() -> None:
    stream = Stream(epochs=7, rd_lambda=3e-4)
    schedule = EpochScheduler(unlimited(stream), VIEWS, 10)
    pieces = []
    while schedule.goes_on:
        pieces += list(schedule.next_pass([2, 0, 4, 1, 3]))
        schedule.weigh_bytes(9000)
    assert pieces == 7 * [[2, 0, 4, 1, 3]], "the clock is not asked within a pass"
    assert (schedule.epochs, schedule.rd_lambda, schedule.stopped_by_clock) == (7, 3e-4, False)
    assert [EpochScheduler(unlimited(stream), VIEWS, 10, scale).epochs for scale in (0.5, 0.01)] == [4, 1]


def sized() -> EpochScheduler:
    return EpochScheduler(FrameBudget(4, 6.0, 1e-3, max_bytes=1000), VIEWS, 10)


def make_pass(pace: EpochScheduler) -> None:
    assert len(list(pace.next_pass(range(VIEWS)))) == 1, "bytes are weighed between passes"


def test_the_weight_of_a_frame_is_that_of_its_last_half() -> None:
    pace = sized()
    for _ in range(4):
        make_pass(pace)
        pace.weigh_bytes(10 * MAX_TRIMMED * 1000)
    # Made with 1e-3 (its pass is a quarter of all: looked at), then three times as much after each pass.
    assert pace.mean_rate_weight == pytest.approx(math.sqrt(9e-3 * 27e-3))


@pytest.mark.parametrize(("estimate", "after"), [(900, 1e-3), (1000, 1e-3), (1999, 1e-3), (4000, 2e-3), (235, 5e-4)])
def test_up_to_twice_the_size_is_left_to_trimming(estimate: float, after: float) -> None:
    pace = sized()
    make_pass(pace)
    make_pass(pace)
    pace.weigh_bytes(estimate)
    assert pace.rd_lambda == pytest.approx(after, rel=0.03)


def test_a_slow_first_view_does_not_end_the_frame() -> None:
    pace, clock = paced(5.0)
    assert views_made(pace, clock, 2.5, 0.4, 0.8) == 3, "1.5 s were left after the first, and no other takes as long"


@dataclass(frozen=True)
class Costs:
    """What a frame's parts take, in seconds: before its passes, its first view besides, a view, and what follows."""

    before: float
    first: float
    view: float
    after: float
    views: int

    @property
    def each(self) -> float:
        return self.view * self.views


@dataclass(frozen=True)
class Made:
    """A frame as it went: seconds in all and of its passes, passes, and the number planned after every iteration."""

    seconds: float
    optimise: float
    epochs: float
    planned: tuple[int, ...]


def made(found: FrameBudget, costs: Costs, slower: float = 1.0) -> Made:
    """A frame whose passes take what they take, as ``optimise`` goes through them."""
    clock = Clock()
    began = clock.now
    clock.now += costs.before
    pace = EpochScheduler(replace(found, started=began, clock=clock), costs.views, 100)
    planned, iterations = [pace.epochs], 0
    while pace.goes_on:
        for _ in pace.next_pass(range(costs.views)):
            if iterations:
                planned.append(pace.epochs)
            clock.now += costs.view * slower**pace.done + (costs.first if iterations == 0 else 0.0)
            iterations += 1
    return Made(clock.now - began + costs.after, pace.optimise, iterations / costs.views, tuple(planned))


def past(frame: Made, costs: Costs) -> Past:
    """What the planner knows of a frame."""
    return Past(1, frame.epochs, 100, costs.before, frame.optimise, costs.after, 3e-4, 1.0, 6.0, 0.0, 9000, 9000)


COSTS = st.builds(
    Costs,
    before=st.floats(0.01, 2),
    first=st.floats(0, 0.5),
    view=st.floats(0.01, 0.5),
    after=st.floats(0, 2),
    views=st.integers(1, 30),
)


@given(COSTS, st.floats(0, 1), st.floats(1, 50), st.floats(0.7, 1.0))
def test_no_frame_is_late_that_costs_what_its_passes_say(
    costs: Costs, share: float, room: float, slower: float
) -> None:
    """Also the first, of which nothing is known: what follows the passes is kept for, if it takes no more than one.

    Passes get cheaper from one to the next, as rows leave: the reserve follows the last, which still covers it.
    """
    costs = replace(costs, after=share * costs.each * slower**30)
    # One view is always made; two, for the first says nothing about the next.
    least = costs.before + costs.first + 2 * costs.view + costs.after
    seconds = room * max(least, costs.after / UNKNOWN_RESERVE) / TIME_MARGIN
    budget, stream = Budget(time=seconds), Stream()
    frame = made(plan(budget, stream, []), costs, slower)
    assert frame.seconds <= seconds
    second = made(plan(budget, stream, [past(frame, costs)]), costs, slower)
    assert second.seconds <= seconds


@given(COSTS, st.floats(0.1, 60))
def test_time_that_is_given_is_used(costs: Costs, seconds: float) -> None:
    """Passes of constant cost: less than a pass and the margin is left, in the first frame two passes at most."""
    budget, stream = Budget(time=seconds), Stream()
    first, most = plan(budget, stream, []), 30
    frame = made(first, costs)
    left = TIME_MARGIN * seconds - frame.seconds
    # The first view pays for what is made once: a frame that ends with it has not learned what another one takes, and
    # goes by the phases before.
    learned = frame.epochs * costs.views > 1
    expected = costs.each if learned else max(costs.each, costs.before)
    unsure = max(0.0, min(expected, UNKNOWN_RESERVE * TIME_MARGIN * seconds) - costs.after)
    assert frame.epochs >= most or left <= unsure + 0.25 * costs.each + costs.view + costs.first + 1e-9
    second = made(plan(budget, stream, [past(frame, costs)]), costs)
    each = costs.each if learned else costs.each + costs.views * costs.first
    assert second.epochs >= most or TIME_MARGIN * seconds - second.seconds <= 0.25 * each + costs.view + 1e-9
    if frame.epochs >= 6:
        assert frame.epochs >= most or frame.seconds >= 0.7 * seconds
        assert second.epochs >= most or second.seconds >= 0.85 * seconds


@given(COSTS, st.floats(0.1, 60))
def test_the_first_frame_knows_its_passes_after_two_views(costs: Costs, seconds: float) -> None:
    """Before that it knows what came before them; a schedule over 30 passes of which 4 are made would never end."""
    assume(costs.views >= 4)
    frame = made(plan(Budget(time=seconds), Stream(), []), costs)
    assert frame.planned[0] <= max(1.0, TIME_MARGIN * seconds / costs.before) + 1e-6
    assert all(abs(planned - frame.epochs) <= 1.5 for planned in frame.planned[2:])
