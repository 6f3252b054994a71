"""Every stage stays within its bound against float64 (docs/reference/numerics.md has the measured table)."""

from __future__ import annotations

import pytest
from numeric_bounds import BOUNDS
from numeric_errors import render_measures
from numeric_method_errors import method_measures
from numeric_scenes import draws

MEASURES = {**render_measures(), **method_measures()}


def test_every_bound_has_a_measurement() -> None:
    missing = [name for name in BOUNDS if name not in MEASURES]
    assert all("(cpu)" in name for name in missing), "only the native kernels may be absent"
    assert set(MEASURES) <= set(BOUNDS)


@pytest.mark.parametrize("stage", BOUNDS)
def test_within_the_bound(stage: str) -> None:
    if stage not in MEASURES:
        pytest.skip("gsstream-cpu-render is not installed")
    errors = {seed: MEASURES[stage](seed) for seed in draws(10)}
    seed = max(errors, key=lambda s: errors[s])
    assert errors[seed] <= BOUNDS[stage].limit, f"seed {seed}: relative error {errors[seed]:.3g}"
