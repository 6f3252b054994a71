"""The rules of the octree and of the latents: what they follow, and that nothing breaks them."""

from __future__ import annotations

from dataclasses import replace

import pytest
from gsstream_s2gs.auto import (
    BASES,
    PIXELS_PER_ANCHOR,
    anchors,
    colour_channels,
    colour_rate,
    log_base,
    max_levels,
    root_exponent,
)
from gsstream_s2gs.latent import LatentResidual
from gsstream_s2gs.octree import StreamingOctree
from hypothesis import given
from hypothesis import strategies as st

from gsstream.testing.common.auto import extreme_scenes

FACTS = extreme_scenes()[0]
SETTINGS = StreamingOctree().config
numbers = st.floats(1, 1e7)


@given(one=numbers, other=numbers)
def test_root_cells_are_as_wide_as_seeds_are_apart(one: float, other: float) -> None:
    low, high = sorted((one, other))
    a, b = (root_exponent(replace(FACTS, span_spacings=n), SETTINGS).value for n in (low, high))
    assert 2 <= a <= b <= 12
    if 3 < a < 12:
        assert 2**-0.5 <= 2**a / low <= 2**0.5


@given(close=st.floats(0, 9), pixels=st.integers(1, 10**4))
def test_more_pixels_ask_for_a_finer_base(close: float, pixels: int) -> None:
    facts = replace(FACTS, closeness=(close,) * 5, height=pixels)
    more = replace(facts, height=2 * pixels)
    assert log_base(more, SETTINGS).value <= log_base(facts, SETTINGS).value


def test_the_base_meets_the_wanted_number_of_anchors_where_it_can() -> None:
    facts = replace(FACTS, seeds=5000, cameras=12, width=160, height=120)
    base = log_base(facts, SETTINGS).value
    wanted = facts.pixels / PIXELS_PER_ANCHOR
    assert all(
        abs(anchors(facts, base, 10) - wanted) <= abs(anchors(facts, b, 10) - wanted) * 1.5 for b in BASES
    )


@pytest.mark.parametrize(("width", "levels"), [(0.04, 1), (0.1, 2), (1.6, 6), (1000.0, 10)])
def test_levels_end_where_cells_are_too_small_to_see(width: float, levels: int) -> None:
    settings = SETTINGS.model_copy(update={"root_exponent": 8})
    assert max_levels(replace(FACTS, span_pixels=256 * width), settings).value == levels


@given(gain=st.floats(-9, 9), more=st.floats(0, 9))
def test_higher_colour_is_sent_where_it_depends_on_the_view(gain: float, more: float) -> None:
    weak, strong = (replace(FACTS, colour_gain=(g, g, g)) for g in (gain, gain + more))
    for rule in (colour_channels, colour_rate):
        assert rule(weak, None).value <= rule(strong, None).value


def test_a_frozen_colour_is_never_sent() -> None:
    rate = colour_rate(replace(FACTS, colour_gain=(0.0, 0.0, 0.0)), None).value
    update = LatentResidual(LatentResidual.Config.model_validate({"shN": {"lr": rate}}))
    assert "shN" not in update.codes()
