"""The regulariser at the extremes: exactly zero at rest, exact sums, a stated dependence on N."""

from __future__ import annotations

import math

import pytest
import torch
from gsstream_s2gs.expected_sparsity import ExpectedSparsity
from hypothesis import given
from hypothesis import strategies as st
from numeric_scenes import some

from gsstream.core.errors import ComponentError
from gsstream.core.hierarchy import Hierarchy
from gsstream.engine.assembly.call_location import Where
from gsstream.engine.assembly.checks import Checks, Look


def flat(nodes: int, rows: int) -> Hierarchy:
    return Hierarchy(torch.arange(rows) % max(nodes, 1), torch.arange(nodes), torch.zeros(nodes, dtype=torch.int64))


def terms(probability: torch.Tensor, residual: torch.Tensor, total: int, **settings: object) -> dict[str, float]:
    part = ExpectedSparsity(ExpectedSparsity.Config(**settings))
    found = part.penalty(probability, residual, flat(len(probability), len(residual)), total)
    return {name: float(value.detach()) for name, value in found.items()}


def test_all_open_costs_the_weight_whatever_n_is() -> None:
    """The mean over N: doubling a scene changes nothing; as printed in the paper (a sum) it doubles."""
    for rows in (1, 10, 1000):
        found = terms(torch.ones(1), torch.ones(rows, 3), rows)
        assert found == pytest.approx({"sparsity": 0.01, "motion": 0.03}, rel=1e-6)
        summed = terms(torch.ones(1), torch.ones(rows, 3), rows, reduction="sum")
        assert summed == pytest.approx({"sparsity": 0.01 * rows, "motion": 0.03 * rows}, rel=1e-6)


@given(st.integers(1, 10_000_000), st.floats(0, 1, width=32), st.floats(0, 1e6, width=32))
@some(40)
def test_a_few_rows_of_ten_million_keep_their_digits(total: int, probability: float, size: float) -> None:
    rows = min(total, 5)
    found = terms(torch.full((1,), probability), torch.full((rows, 3), size), total)
    assert found["sparsity"] == pytest.approx(0.01 * probability * rows / total, rel=2e-7, abs=1e-44)
    assert found["motion"] == pytest.approx(0.01 * probability * 3 * size**2 * rows / total, rel=2e-7, abs=1e-44)


def test_one_large_term_does_not_swallow_many_small_ones() -> None:
    """10^6 rows of 1e-4 beside one of 1e3: a float32 sum that has reached 1e4 adds nothing more."""
    rows = 1_000_001
    residual = torch.full((rows, 3), 1e-4 / math.sqrt(3))
    residual[0] = 1e3 / math.sqrt(3)
    found = terms(torch.ones(1), residual, rows, reduction="sum", lambda2=1.0)
    squares = residual.double().square().sum(1)
    assert found["motion"] == pytest.approx(math.fsum(squares.tolist()), rel=1e-7)


def test_a_residual_that_diverged_is_refused_by_name() -> None:
    part = ExpectedSparsity()
    found = part.penalty(torch.ones(1), torch.full((2, 3), 1e30), flat(1, 2), 2)
    with pytest.raises(ComponentError, match=r"penalty 'motion': expected one finite number, got inf"):
        Look(Checks.FRAME, "regularizer", part, Where(3, 5)).terms(found)


@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16])
def test_half_precision_inputs_are_summed_in_double(kind: torch.dtype) -> None:
    probability, residual = torch.rand(50).to(kind), torch.randn(4000, 3).to(kind)
    found = terms(probability, residual, 4000)
    exact = terms(probability.double(), residual.double(), 4000)
    assert found == pytest.approx(exact, rel=2 * torch.finfo(kind).eps)
