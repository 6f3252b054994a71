"""Gumbel-sigmoid gates: exact levels, calibration, gradients that stay alive, extremes."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from gsstream_s2gs.gumbel_sigmoid import GumbelSigmoid, gumbel, logistic
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from gsstream.api import ShapeError


def sampler(**settings_: object) -> GumbelSigmoid:
    return GumbelSigmoid(GumbelSigmoid.Config(**settings_))


def at(logits: list[float] | torch.Tensor, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    return torch.as_tensor(logits, dtype=dtype)


class TestLevels:
    @pytest.mark.parametrize("levels", [1, 2, 10, 255])
    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_every_gate_is_exactly_a_level(self, levels: int, dtype: torch.dtype) -> None:
        """Exactly k / levels as the decoder divides it, not soft + (hard - soft) an ulp beside it."""
        gates = sampler(levels=levels).sample(at(torch.linspace(-4, 4, 5001), dtype), None)
        symbol = torch.round(gates * levels).to(torch.int64)
        numpy_type = np.float32 if dtype == torch.float32 else np.float64
        assert gates.numpy().tobytes() == (symbol.numpy().astype(numpy_type) / numpy_type(levels)).tobytes()
        assert set(symbol.tolist()) == set(range(levels + 1))
        assert sampler(levels=levels).num_levels == levels

    def test_the_papers_map_from_confidence_to_gate(self) -> None:
        """Temperature 0.3, one decimal: what each confidence becomes."""
        p = torch.tensor([0.29, 0.30, 0.40, 0.50, 0.60, 0.70, 0.72], dtype=torch.float64)
        gates = sampler().sample(at(torch.logit(p), torch.float64), None)
        assert [round(float(g), 1) for g in gates] == [0.0, 0.1, 0.2, 0.5, 0.8, 0.9, 1.0]

    def test_the_edge_of_the_dead_zone(self) -> None:
        edge = 0.3 * math.log(0.05 / 0.95)
        assert edge == pytest.approx(-0.8833, abs=1e-4)
        gates = sampler().sample(at([edge - 1e-4, edge + 1e-4]), None)
        assert gates.tolist() == [0.0, pytest.approx(0.1)]

    def test_a_tie_is_closed(self) -> None:
        assert sampler(levels=1).sample(at([0.0]), None).tolist() == [0.0]  # soft gate 0.5, half to even

    @pytest.mark.parametrize("levels", [1, 10])
    @pytest.mark.parametrize("noise", ["logistic", "none", "gumbel"])
    def test_extreme_logits(self, levels: int, noise: str) -> None:
        gate = sampler(levels=levels, noise=noise)
        for ends in ([-1e4, 1e4], [-3e38, 3e38]):
            logits = torch.tensor(ends, requires_grad=True)
            draw = gate.noise(2, torch.Generator().manual_seed(0))
            gates = gate.sample(logits, draw)
            assert gates.tolist() == [0.0, 1.0]
            probability = gate.open_probability(logits)
            assert probability.tolist() == [0.0, 1.0]
            (gradient,) = torch.autograd.grad(gates.sum() + probability.sum(), logits)
            assert torch.isfinite(gradient).all()
        started = gate.init(torch.tensor([-1e4, 0.0, 1e4]))
        assert started.tolist() == pytest.approx([-math.log(1000), 0.0, math.log(1000)])
        assert torch.equal(gate.bound(started), started)

    @pytest.mark.parametrize("temperature", [0.01, 10.0])
    def test_limits_of_the_temperature(self, temperature: float) -> None:
        logits = torch.linspace(-7, 7, 101).requires_grad_()
        gates = sampler(temperature=temperature).sample(logits, None)
        (gradient,) = torch.autograd.grad(gates.sum(), logits)
        assert torch.isfinite(gates).all()
        assert torch.isfinite(gradient).all()

    def test_colder_is_harder(self) -> None:
        logits = at(torch.linspace(-3, 3, 601))
        spread = [
            float(torch.minimum(g, 1 - g).mean())
            for g in (sampler(temperature=t, levels=255).sample(logits, None) for t in (3.0, 1.0, 0.3, 0.1, 0.01))
        ]
        assert spread == sorted(spread, reverse=True)

    @pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
    def test_confidence_must_be_finite(self, bad: float) -> None:
        with pytest.raises(ShapeError, match=r"confidence logits: .* index \[1\]"):
            sampler().init(torch.tensor([0.0, bad]))

    def test_no_nodes(self) -> None:
        gate = sampler()
        logits = gate.init(torch.zeros(0))
        noise = gate.noise(0, torch.Generator())
        assert gate.sample(logits, noise).shape == gate.open_probability(logits).shape == (0,)


class TestCalibration:
    @pytest.mark.parametrize("levels", [1, 3, 10])
    @pytest.mark.parametrize("noise", ["logistic", "gumbel"])
    @pytest.mark.parametrize("temperature", [0.3, 1.0])
    def test_share_of_open_gates_is_the_open_probability(self, levels: int, noise: str, temperature: float) -> None:
        gate, draws = sampler(levels=levels, noise=noise, temperature=temperature), 4096
        p = torch.linspace(0.05, 0.95, 19, dtype=torch.float64)
        eta = 0.5 / levels
        margin = torch.logit(p) if noise == "logistic" else torch.log(-torch.log1p(-p))
        alpha = (margin + temperature * math.log(eta / (1 - eta))).float()
        torch.testing.assert_close(gate.open_probability(at(alpha)), p.float(), rtol=1e-5, atol=1e-6)
        every = alpha.repeat(draws)
        gates = gate.sample(at(every), gate.noise(len(every), torch.Generator().manual_seed(1)))
        opened = (gates > 0).double().reshape(draws, 19).mean(0)
        worst = ((opened - p).abs() / (p * (1 - p) / draws).sqrt()).max()
        assert float(worst) < 4, f"{float(worst):.2f} sigma"

    def test_the_papers_threshold(self) -> None:
        alpha = torch.tensor([-2.0, 0.0, 1.5], dtype=torch.float64)
        expected = torch.sigmoid(alpha - 0.3 * math.log(0.05 / 0.95))
        torch.testing.assert_close(sampler().open_probability(at(alpha, torch.float64)), expected)

    def test_binary_open_probability_is_the_confidence(self) -> None:
        p = torch.linspace(0.01, 0.99, 50)
        torch.testing.assert_close(sampler(levels=1).open_probability(at(torch.logit(p))), p)

    def test_noise_has_the_law_it_claims(self) -> None:
        n = 200_000
        draw = sampler().noise(n, torch.Generator().manual_seed(0)).double()
        assert abs(float(draw.mean())) < 4 * math.pi / math.sqrt(3 * n)
        assert float(draw.var()) == pytest.approx(math.pi**2 / 3, rel=0.02)
        single = sampler(noise="gumbel").noise(n, torch.Generator().manual_seed(0)).double()
        assert float(single.mean()) == pytest.approx(0.5772, abs=4 * math.pi / math.sqrt(6 * n))

    @pytest.mark.parametrize("law", [logistic, gumbel])
    def test_ends_of_the_generator(self, law) -> None:
        ends = law(torch.tensor([0.0, 2.0**-24, 1 - 2.0**-24]))
        assert torch.isfinite(ends).all()
        assert ends.dtype == torch.float32
        assert float(ends.abs().max()) < 17.4
        assert bool((ends.diff() > 0).all())

    def test_logistic_noise_is_symmetric(self) -> None:
        # The lattice k / 2^24 is shifted by half a step: u and 1 - u are both in it.
        u = torch.tensor([0.0, 0.25, 0.4])
        torch.testing.assert_close(logistic(u), -logistic(1 - 2.0**-24 - u))

    def test_seeds(self) -> None:
        gate = sampler()
        state = torch.get_rng_state()
        a, b = (gate.noise(50, torch.Generator().manual_seed(s)) for s in (0, 0))
        assert torch.equal(a, b)
        assert not torch.equal(a, gate.noise(50, torch.Generator().manual_seed(1)))
        assert torch.equal(torch.get_rng_state(), state)

    def test_released_training_is_deterministic(self) -> None:
        assert sampler(noise="none").noise(5, torch.Generator()) is None


class TestSample:
    @given(
        st.lists(st.floats(-8, 8, width=32), min_size=1, max_size=20),
        st.floats(0, 3, width=32),
        st.sampled_from([1, 10]),
        st.integers(0, 99),
    )
    @settings(max_examples=100, deadline=None)
    def test_monotone_in_the_logit(self, logits: list[float], up: float, levels: int, seed: int) -> None:
        gate = sampler(levels=levels)
        noise = gate.noise(len(logits), torch.Generator().manual_seed(seed))
        low, high = at(logits), at(torch.tensor(logits) + up)
        assert bool((gate.sample(high, noise) >= gate.sample(low, noise)).all())
        assert bool((gate.open_probability(high) >= gate.open_probability(low)).all())

    def test_noise_is_data(self) -> None:
        gate, logits = sampler(), at(torch.linspace(-3, 3, 40))
        noise = gate.noise(40, torch.Generator().manual_seed(5)).requires_grad_()
        order = torch.randperm(40, generator=torch.Generator().manual_seed(6))
        gates = gate.sample(logits, noise)
        assert torch.equal(gate.sample(logits, noise), gates)
        assert torch.equal(gate.sample(logits[order], noise[order]), gates[order])
        assert not gates.requires_grad  # nothing flows into the noise
        assert not torch.equal(gate.sample(logits, None), gates)

    @pytest.mark.parametrize("levels", [1, 10])
    def test_gradient_is_that_of_the_soft_gate_also_at_zero_and_one(self, levels: int) -> None:
        logits = torch.tensor([-2.0, -0.9, 0.0, 0.9, 2.0], dtype=torch.float64, requires_grad=True)
        gates = sampler(levels=levels).sample(logits, None)
        assert gates[0] == 0
        assert gates[-1] == 1
        (gradient,) = torch.autograd.grad(gates.sum(), logits)
        soft = torch.sigmoid(logits.detach() / 0.3)
        torch.testing.assert_close(gradient, soft * (1 - soft) / 0.3)
        assert bool((gradient > 0).all())

    def test_released_clamp_kills_the_gradient_at_the_ends(self) -> None:
        logits = torch.tensor([-2.0, 0.0, 2.0], requires_grad=True)
        gate = sampler(clamp_gradient=True)
        (gradient,) = torch.autograd.grad(gate.sample(logits, None).sum(), logits)
        assert gradient[0] == gradient[2] == 0
        assert gradient[1] > 0
        assert torch.equal(gate.sample(logits, None), sampler().sample(logits, None))
        binary = torch.linspace(-3, 3, 30).requires_grad_()
        gates = sampler(levels=1, clamp_gradient=True).sample(binary, None)
        (dead,) = torch.autograd.grad(gates.sum(), binary)
        assert not dead.any()  # the collapse of binary gates in the released code

    def test_open_probability_is_differentiable(self) -> None:
        for noise in ("logistic", "gumbel"):
            logits = torch.linspace(-5, 5, 11, dtype=torch.float64).requires_grad_()
            gate = sampler(noise=noise)
            (found,) = torch.autograd.grad(gate.open_probability(logits).sum(), logits)
            with torch.no_grad():
                ends = [gate.open_probability(logits + e) for e in (1e-6, -1e-6)]
            torch.testing.assert_close(found, (ends[0] - ends[1]) / 2e-6, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize(
    "bad", [{"temperature": 0.0}, {"levels": 0}, {"levels": 256}, {"noise": "normal"}, {"logit_bound": 0.0}, {"tau": 1}]
)
def test_impossible_settings_are_refused(bad: dict[str, object]) -> None:
    with pytest.raises(ValidationError, match=next(iter(bad))):
        GumbelSigmoid.Config(**bad)
