"""Every stage stays within its bound against float64 (docs/reference/numerics.md has the measured table)."""

from __future__ import annotations

import re

import pytest
from numeric_bounds import BOUNDS
from numeric_errors import render_measures
from numeric_method_errors import method_measures
from numeric_scenes import draws
from worst_errors import BEGIN, END, PAGE

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


ROOT = PAGE.parents[2]
TEXT = PAGE.read_text(encoding="utf-8")
NAMED = sorted(set(re.findall(r"`((?:tests|plugins)/[\w/]+\.py(?:::\w+)+)`", TEXT)))


def test_every_named_test_exists() -> None:
    assert len(NAMED) > 50
    missing = []
    for name in NAMED:
        file, *parts = name.split("::")
        path = ROOT / file
        source = path.read_text(encoding="utf-8") if path.exists() else ""
        kinds = [*(rf"^class {part}\b" for part in parts[:-1]), rf"^\s*def {parts[-1]}\("]
        if not all(re.search(kind, source, re.MULTILINE) for kind in kinds):
            missing.append(name)
    assert not missing


@pytest.mark.parametrize("stage", BOUNDS)
def test_the_table_has_every_stage_within_the_bound_that_is_tested(stage: str) -> None:
    lines = TEXT.split(BEGIN)[1].split(END)[0].splitlines()
    rows = [line.split("|") for line in lines if line.startswith(f"| {stage} |")]
    assert len(rows) == 1
    _, _, error, bound, _, _ = rows[0]
    assert float(bound) == BOUNDS[stage].limit
    assert float(error) <= BOUNDS[stage].limit
