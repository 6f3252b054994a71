"""Progressive training holds back the finest levels that hold anybody, whatever the structure laid."""

from __future__ import annotations

import numpy as np
import pytest

from gsstream.engine.step.levels import current_level, level_schedule
from gsstream.recipe.model import Stream

PROGRESSIVE = Stream(progressive=True)


def units(*counts: int) -> np.ndarray:
    return np.repeat(np.arange(len(counts)), counts).astype(np.uint8)


def waiting_share(unit_of: np.ndarray, fraction: float) -> float:
    schedule = level_schedule(PROGRESSIVE, unit_of)
    return float((unit_of > current_level(schedule, fraction)).mean()) if schedule else 0.0


def test_empty_levels_are_not_counted() -> None:
    """Anchors per level as counted in a run: counting all eight, the schedule would begin at a level that is empty."""
    rows = units(148, 161, 54, 32, 2, 0, 0, 0)
    assert waiting_share(rows, 0.0) == pytest.approx(34 / 397)
    assert level_schedule(PROGRESSIVE, rows) == level_schedule(PROGRESSIVE, units(148, 161, 54, 32, 2))


def test_a_gap_between_levels_costs_no_stage() -> None:
    schedule = level_schedule(PROGRESSIVE, units(5, 0, 0, 4, 3))
    assert [level for _, level in schedule] == [3, 4]


def test_stages_grow_by_omega_and_all_take_part_at_the_end() -> None:
    schedule = level_schedule(PROGRESSIVE, units(1, 1, 1, 1, 1, 1))
    ends = [end for end, _ in schedule]
    assert [level for _, level in schedule] == [3, 4, 5]
    assert np.diff([0.0, *ends]) == pytest.approx(np.array([1, 1.5, 2.25]) / 4.75)
    assert waiting_share(units(1, 1, 1, 1, 1, 1), 1 - 1e-12) == 0


@pytest.mark.parametrize("rows", [units(7), units(0, 0, 7), np.zeros(0, np.uint8)])
def test_nothing_waits_where_there_is_one_level(rows: np.ndarray) -> None:
    assert level_schedule(PROGRESSIVE, rows) == ()


def test_off_unless_the_recipe_asks() -> None:
    assert level_schedule(Stream(), units(1, 1, 1, 1)) == ()
