"""Rules by which settings follow the size of a picture: they have no step, so no two close widths are two encoders."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsstream.core import picture_size
from gsstream.core.picture_size import (
    area_price,
    bit_price_factor,
    densify_factor,
    enlargement,
    far_weight,
    prune_factor,
)
from gsstream.encode import encoder_for, open_recording
from gsstream.metrics import psnr
from gsstream.play import render

#: Rule by width, and its largest value.
RULES: dict[str, tuple[Callable[[int], float], float]] = {
    "enlargement": (enlargement, 16.0),
    "densify_factor": (densify_factor, 1.0),
    "prune_factor": (prune_factor, 1.0),
    "area_price": (area_price, 2e-4),
    "far_weight": (far_weight, 1.0),
    "bit_price_factor": (lambda width: bit_price_factor(width * width * 3 // 4), bit_price_factor(5120 * 3840)),
}


@pytest.mark.parametrize("name", RULES)
@given(width=st.integers(16, 5119))
def test_a_pixel_of_width_changes_a_rule_by_less_than_half_a_percent_of_its_range(name: str, width: int) -> None:
    rule, largest = RULES[name]
    assert abs(rule(width + 1) - rule(width)) <= 0.005 * largest


@pytest.mark.parametrize("name", RULES)
def test_a_rule_goes_one_way(name: str) -> None:
    values = [RULES[name][0](width) for width in range(16, 5120, 16)]
    steps = [after - before for before, after in itertools.pairwise(values)]
    assert all(step >= 0 for step in steps) or all(step <= 0 for step in steps)
    assert len(set(values)) > 10, "the rule is a switch"


def test_small_pictures_have_the_settings_as_they_are() -> None:
    assert [enlargement(320), densify_factor(320), prune_factor(320), area_price(640), far_weight(640)] == [
        1,
        1,
        1,
        0,
        1,
    ]
    assert (far_weight(1280), area_price(1280)) == (0.0, 2e-4)


def test_no_rule_is_left_out() -> None:
    ours = {
        name for name, value in vars(picture_size).items() if getattr(value, "__module__", "") == picture_size.__name__
    }
    assert ours - {"largeness"} == set(RULES)


def test_two_pixels_of_width_change_neither_bytes_nor_quality_much() -> None:
    """Encoded: frame 0 is a draw that differs by up to a decibel between any two sizes, hence the wide bounds."""
    found = []
    for width in (959, 961):
        with open_recording(f"synthetic:frames=3&views=3&width={width}&height=64&noise=0.01&supersample=1") as source:
            encoder = encoder_for("s2gs-edge", source, {"first_frame.max_iterations": 60})
            encoder.encode(source.frame(0))
            step = encoder.encode(source.frame(1))
            truth = source.frame(1, "test")
        image = render(step.state.player.gaussians, truth.cameras, background=step.state.player.meta.background)
        changed = step.metrics["changed_tiles"] * width * 64
        found.append((len(step.packet.data) / changed, psnr(np.clip(image, 0, 1), truth.as_float32().images[0])))
    (size, quality), (other_size, other_quality) = found
    assert 0.6 < other_size / size < 1.7
    assert abs(other_quality - quality) < 2.0
