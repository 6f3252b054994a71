"""The smooth estimate of a residual's bits: a probability model, its gradient, and how near it is to the coder."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gsstream.packet.symbols import encode_symbols
from gsstream.parts.residual.rate import MIN_SPREAD, channel_spread, laplace_bits, laplace_gradient, rate_gradient

SEEDS = st.integers(0, 2**32 - 1)


@settings(max_examples=40, deadline=None)
@given(st.floats(MIN_SPREAD, 30), st.floats(0.01, 5))
def test_the_masses_of_all_symbols_sum_to_one(spread, step):
    symbols = torch.arange(-400, 401, dtype=torch.float64)[:, None]
    bits = laplace_bits(symbols * step, step, torch.tensor([spread], dtype=torch.float64))
    assert float((2.0**-bits).sum()) == pytest.approx(1, abs=1e-5)


@settings(max_examples=40, deadline=None)
@given(SEEDS, st.floats(0.01, 5))
def test_the_gradient_is_the_derivative(seed, step):
    rng = np.random.default_rng(seed)
    latents = torch.from_numpy(rng.choice([0.3, 3, 30]) * step * rng.normal(size=(50, 3))).requires_grad_()
    spread = torch.from_numpy(rng.uniform(MIN_SPREAD, 20, 3))
    laplace_bits(latents, step, spread).sum().backward()
    torch.testing.assert_close(laplace_gradient(latents.detach(), step, spread), latents.grad)
    assert torch.autograd.gradcheck(lambda x: laplace_bits(x, step, spread), latents[:5])


@pytest.mark.parametrize("spread", [MIN_SPREAD, 1.0, 200.0])
@pytest.mark.parametrize("value", [0.0, 0.4999, 0.5, 0.5001, 3.0, 1e4])
def test_it_is_finite_odd_and_continuous(value, spread):
    spread = torch.tensor([spread])
    both = torch.tensor([[value], [-value]])
    gradient = laplace_gradient(both, 1.0, spread)
    assert torch.isfinite(gradient).all()
    assert torch.equal(gradient[0], -gradient[1])
    assert torch.isfinite(laplace_bits(both, 1.0, spread)).all()
    beside = laplace_bits(torch.tensor([[value + 1e-3]]), 1.0, spread) - laplace_bits(both[:1], 1.0, spread)
    assert float(beside.abs()) < 0.01
    if value == 0:
        assert gradient[0] == 0


@pytest.mark.parametrize("spread", [0.4, 1.0, 4.0])
def test_it_is_within_an_eighth_of_what_the_coder_pays(spread):
    rng = np.random.default_rng(1)
    symbols = np.rint(rng.laplace(scale=spread, size=(20_000, 2))).astype(np.int32)
    latents = torch.from_numpy(symbols).float()
    bits = float(laplace_bits(latents, 1.0, channel_spread(latents, 1.0)).sum())
    assert bits == pytest.approx(8 * len(encode_symbols(symbols)), rel=0.125)


def test_rows_behind_closed_gates_cost_nothing_and_a_larger_weight_has_a_larger_gradient():
    latents = torch.cat([torch.full((4, 3), 0.3), torch.zeros(4, 1)], 1)
    gates = torch.tensor([0.0, 0.1, 1.0, 0.0])
    steps = torch.tensor([0.1, 0.1, 0.1, 0.05])
    once = rate_gradient(latents, steps, gates, 1e-3)
    assert once[0].eq(0).all()
    assert once[1, :3].gt(0).all()
    assert once[:, 3].eq(0).all()
    torch.testing.assert_close(rate_gradient(latents, steps, gates, 2e-3), 2 * once)
    # Side by side, each channel by its own step: what every attribute would get alone.
    alone = [rate_gradient(latents[:, c : c + 1], steps[c : c + 1], gates, 1e-3) for c in range(4)]
    torch.testing.assert_close(once, torch.cat(alone, 1))
