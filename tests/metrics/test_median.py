"""The quick median against numpy's own: to the bit, because thresholds are compared with what it says."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsstream.core.median import median
from gsstream.metrics.noise import median_deviation

KINDS = pytest.mark.parametrize("kind", [np.float32, np.float64])


@KINDS
@given(size=st.integers(1, 600), seed=st.integers(0, 999), few=st.booleans())
def test_median_is_numpys(kind: type, size: int, seed: int, few: bool) -> None:
    rng = np.random.default_rng(seed)
    values = (rng.integers(-2, 3, size) / 255 if few else rng.normal(size=size)).astype(kind)
    found, wanted = median(values), np.median(values)
    assert (found, found.dtype) == (wanted, wanted.dtype)
    deviation = np.median(np.abs(values - wanted))
    assert (median_deviation(values), median_deviation(values).dtype) == (deviation, deviation.dtype)


@KINDS
@pytest.mark.parametrize("shape", [(1,), (4, 1), (3, 5, 3), (60, 80, 3)])
def test_median_of_a_table_leaves_it_alone(kind: type, shape: tuple[int, ...]) -> None:
    values = np.random.default_rng(1).normal(size=shape).astype(kind)
    before = values.copy()
    assert median(values) == np.median(values)
    assert median_deviation(values) == np.median(np.abs(values - np.median(values)))
    np.testing.assert_array_equal(values, before)


@pytest.mark.parametrize("place", [0, 3, 8, 9])
@pytest.mark.parametrize("size", [10, 11])
def test_median_of_what_is_not_finite(size: int, place: int) -> None:
    values = np.arange(float(size))
    values[place] = np.inf
    assert median(values) == np.median(values)
    values[place] = np.nan
    assert np.isnan(median(values))
    assert np.isnan(median_deviation(values))
