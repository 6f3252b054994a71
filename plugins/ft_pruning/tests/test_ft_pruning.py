"""Fixed-threshold pruning against the paper's equations, written out with probabilities."""

from __future__ import annotations

import pytest
import torch
from gsstream_ft_pruning.fixed_threshold import FixedThreshold
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from gsstream.api import Hierarchy, ShapeError

TAUS = (0.5, 0.8, 0.9, 0.95)


def roots_only(node_of: list[int]) -> Hierarchy:
    nodes = torch.arange(max(node_of) + 1)
    return Hierarchy(torch.tensor(node_of), nodes, torch.zeros_like(nodes))


@settings(max_examples=50, deadline=None)
@given(
    p=st.lists(st.floats(0.001, 0.999), min_size=6, max_size=6),
    node_of=st.permutations([0, 0, 1, 1, 2, 2]),
    tau=st.sampled_from(TAUS),
)
def test_equals_the_paper_on_probabilities(p: list[float], node_of: list[int], tau: float) -> None:
    if any(abs(x - tau) < 1e-9 for x in p):
        return  # at the threshold itself the two ways of writing it may round apart
    part = FixedThreshold(FixedThreshold.Config(tau=tau))
    logits = torch.logit(torch.tensor(p, dtype=torch.float64))
    got = torch.sigmoid(part.propagate(logits, roots_only(node_of)))
    kept = [x if x >= tau else 0.0 for x in p]
    for node in range(3):
        want = max(value for value, owner in zip(kept, node_of, strict=True) if owner == node)
        assert float(got[node]) == pytest.approx(want, abs=1e-9)


@pytest.mark.parametrize("tau", TAUS)
def test_what_is_exactly_at_the_threshold_passes(tau: float) -> None:
    part = FixedThreshold(FixedThreshold.Config(tau=tau))
    at = torch.tensor([tau], dtype=torch.float64).log() - torch.log1p(-torch.tensor([tau], dtype=torch.float64))
    below = torch.nextafter(at, torch.full_like(at, -torch.inf))
    hierarchy = roots_only([0])
    assert float(part.propagate(at, hierarchy)) == float(at)
    assert float(part.propagate(below, hierarchy)) == part.config.floor


def test_a_pruned_gaussian_has_no_gradient_and_the_winner_has_it_all() -> None:
    logits = torch.tensor([3.0, 1.0, -1.0], requires_grad=True)
    part = FixedThreshold()
    (gradient,) = torch.autograd.grad(part.propagate(logits, roots_only([0, 1, 1])).sum(), logits)
    assert gradient.tolist() == [1.0, 0.0, 0.0]


def test_faults_are_named() -> None:
    with pytest.raises(ShapeError, match=r"logits: expected shape \[2\], got \[3\]"):
        FixedThreshold().propagate(torch.zeros(3), roots_only([0, 1]))
    circle = Hierarchy(torch.tensor([0]), torch.tensor([1, 0]), torch.tensor([0, 0]))
    with pytest.raises(ShapeError, match="cycle among 2 nodes"):
        FixedThreshold().propagate(torch.zeros(1), circle)
    for tau in (0.0, 1.0, -0.5):
        with pytest.raises(ValidationError, match="tau"):
            FixedThreshold.Config(tau=tau)
