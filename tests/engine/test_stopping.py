"""Early stopping: what counts as a gain, and which tiles a view is judged on."""

from __future__ import annotations

import pytest
import torch
from gsstream.engine.stopping import Gains, watch
from hypothesis import given
from hypothesis import strategies as st


def epoch(gains: Gains, losses: list[float], tiles: int = 5) -> float:
    for view, loss in enumerate(losses):
        gains.note(view, loss, tiles)
    return gains.end_epoch()


def test_share_of_what_was_gained() -> None:
    gains = Gains(2)
    assert epoch(gains, [1.0, 1.0]) == 1.0  # nothing to compare
    assert epoch(gains, [0.5, 0.5]) == 1.0  # all there is
    assert epoch(gains, [0.25, 0.25]) == pytest.approx(0.5 / 1.5)
    assert epoch(gains, [0.25, 0.3]) == 0.0  # worse is no gain


def test_other_tiles_do_not_compare() -> None:
    gains = Gains(3)
    epoch(gains, [1.0, 1.0, 1.0])
    gains.note(0, 9.0, 6)  # grew by a tile
    gains.note(1, 0.5, 5)
    gains.note(2, 0.5, 5)
    assert gains.end_epoch() == 1.0
    assert epoch(gains, [8.0, 0.5, 0.5], 6) == 1.0, "one of three compares: not enough to stop"


@given(st.lists(st.lists(st.booleans(), min_size=12, max_size=12), min_size=1, max_size=6))
def test_watched_tiles_hold_what_is_touched_and_never_shrink(steps: list[list[bool]]) -> None:
    watched = None
    for step in steps:
        tiles = torch.tensor(step).reshape(3, 4)
        before, watched = watched, watch(watched, tiles)
        assert not bool((tiles & ~watched).any())
        assert before is None or not bool((before & ~watched).any())
