"""What a run says of its cameras, before frame 0 and after it."""

from __future__ import annotations

import math
from typing import Any

import pytest
from rigs import inwards, looking, parallel

from gsstream.core.cameras import Cameras
from gsstream.encode import assemble, recipe_for
from gsstream.engine.run.few_cameras import AROUND, ONE_SIDE, expectation, first_frame_summary, widest_gap
from gsstream.plugins.catalog import load_catalog


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
    for part in ("seeds: the recording", "the mean of its images", "256 large seeds", "dropout 0.2, because 6 cameras",
                 "smoothness of depth 1, because 6 cameras around a room"):  # fmt: skip
        assert part in found
    many = line(inwards(12, 360))
    assert "dropout" not in many
    assert "smoothness" not in many
    own = line(inwards(6, 360), dropout=0.1, depth_smoothness=0, shell=False)
    assert "dropout 0.1, as the recipe says" in own
    assert "smoothness" not in own
    assert "large seeds" not in own
