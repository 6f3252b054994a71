"""Confidence at the extremes: finite, within its limit, ordered like the magnitudes, free of units where it says so."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from gsstream_s2gs.normalise import robust
from gsstream_s2gs.view_gradient import LIMIT, ViewSpaceGradient
from hypothesis import given
from hypothesis import strategies as st
from numeric_scenes import dictated, some

from gsstream.core.errors import ShapeError
from gsstream.testing.cases import get_case

NORMALISATIONS = {
    "robust": {},
    "robust, relative": {"epsilon_mode": "relative"},
    "robust, no epsilon": {"epsilon": 0.0},
    "ratio": {"normalisation": "ratio"},
    "minmax": {"normalisation": "minmax"},
    "noise": {"normalisation": "noise"},
}
#: What a frame's gradients may look like, in any unit.
MAGNITUDES = {
    "all equal": [1.0] * 9,
    "all zero": [0.0] * 9,
    "one Gaussian": [1.0],
    "one still Gaussian": [0.0],
    "none": [],
    "a huge outlier among equals": [1.0] * 8 + [1e7],
    "a huge outlier among still ones": [0.0] * 8 + [1.0],
    "more than half still": [0.0] * 5 + [1.0, 2.0, 3.0],
    "neighbours in float32": [1.0, 1.0 + 2.0**-23, 1.0 - 2.0**-24],
}


def estimated(magnitudes: object, **settings: object) -> torch.Tensor:
    part = ViewSpaceGradient(ViewSpaceGradient.Config(**settings))
    return part.estimate(dictated(magnitudes))


@pytest.mark.parametrize("unit", [1e-40, 1e-30, 1.0, 1e30])
@pytest.mark.parametrize("case", MAGNITUDES)
@pytest.mark.parametrize("how", NORMALISATIONS)
def test_finite_and_limited_whatever_the_magnitudes(how: str, case: str, unit: float) -> None:
    magnitudes = np.float32(unit) * np.array(MAGNITUDES[case], np.float32)
    logits = estimated(magnitudes, **NORMALISATIONS[how])
    assert logits.dtype == torch.float32
    assert logits.shape == (len(magnitudes),)
    assert bool(torch.isfinite(logits).all())
    assert bool((logits.abs() <= LIMIT).all())
    if how != "noise":  # there the noise one expects differs from Gaussian to Gaussian
        order = np.argsort(magnitudes, kind="stable")
        assert bool((logits[order].diff() >= 0).all()), "a larger gradient never means less confidence"


@given(
    st.lists(st.floats(0, 1e6, width=32), min_size=1, max_size=30),
    st.integers(-100, 70),
)
@some(60)
def test_the_relative_epsilon_knows_no_units(values: list[float], power: int) -> None:
    m = torch.tensor(values, dtype=torch.float64)
    # Zero stays zero and a power of two is exact, so the logits must agree to the last bit or nearly.
    torch.testing.assert_close(
        robust(m * 2.0**power, 1e-3, True, LIMIT), robust(m, 1e-3, True, LIMIT), rtol=1e-12, atol=1e-12
    )


@pytest.mark.parametrize("unit", [1e-30, 1e-6, 1e6, 1e30])
def test_pixels_or_half_images_are_the_same_with_the_relative_epsilon(unit: float) -> None:
    magnitudes = unit * np.linspace(0.5, 3, 11)
    pixel, ndc = (estimated(magnitudes, epsilon_mode="relative", units=u) for u in ("pixel", "ndc"))
    torch.testing.assert_close(pixel, ndc, rtol=1e-5, atol=1e-5)
    # The paper's absolute epsilon has a unit: below it everybody starts near 1/2, above it nothing changes any more.
    absolute = estimated(magnitudes, units="pixel")
    if unit <= 1e-6:
        assert float(absolute.abs().max()) < 0.02
    else:
        torch.testing.assert_close(absolute, estimated(magnitudes, units="pixel", epsilon=0.0), rtol=1e-4, atol=1e-4)


def test_without_spread_the_sign_of_the_deviation_decides() -> None:
    """MAD 0 and epsilon 0: 0 / 0 and x / 0 have stated values."""
    values = [1.0] * 5 + [2.0, 0.5]
    assert estimated(values, epsilon=0.0, statistics="seen").tolist() == [0.0] * 5 + [LIMIT, -LIMIT]
    # What a change touches is never less likely to change than what it does not touch.
    assert estimated(values, epsilon=0.0, floor=-3.0).tolist() == [0.0] * 5 + [LIMIT, -3.0]


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_gradient_that_is_not_finite_is_refused_with_its_place(bad: float) -> None:
    with pytest.raises(ShapeError, match=r"screen gradient of view 0 at frame 1: .* index \[2, 0\]"):
        ViewSpaceGradient().estimate(dictated([1.0, 2.0, bad]))


@pytest.mark.parametrize("sigma", [0.0, 1e-30, 1e3])
def test_a_camera_without_noise_and_one_of_noise_alone(sigma: float) -> None:
    case = replace(get_case("line"), sigma=sigma)
    logits = ViewSpaceGradient(ViewSpaceGradient.Config(normalisation="noise")).estimate(case)
    assert bool(torch.isfinite(logits).all())
    if sigma == 1e3:
        assert float(logits.max()) < 0, "nothing is seen to move in noise this strong"


def test_a_black_and_a_white_frame() -> None:
    case = get_case("line")
    for level in (0.0, 1.0):
        flash = replace(case, now=tuple(torch.full_like(image, level) for image in case.now))
        assert bool(torch.isfinite(ViewSpaceGradient().estimate(flash)).all())
    blank = replace(case, now=tuple(torch.zeros_like(i) for i in case.now), before=tuple(case.before))
    same = ViewSpaceGradient(ViewSpaceGradient.Config(loss="l2norm", aggregate="sum-of-norms", normalisation="ratio"))
    assert bool(torch.isfinite(same.estimate(blank)).all()), "render and photograph agree exactly where both are black"
