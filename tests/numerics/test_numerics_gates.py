"""Gates and their price at the extremes: exact levels and sums, live gradients, laws that hold."""

from __future__ import annotations

import math

import pytest
import torch
from gsstream_binary_ste.binary import BinarySteGate
from gsstream_s2gs.expected_sparsity import ExpectedSparsity
from gsstream_s2gs.gumbel_sigmoid import GumbelSigmoid, gumbel, logistic, sigmoid_derivative
from hypothesis import given
from hypothesis import strategies as st
from numeric_scenes import some

from gsstream.core.errors import ComponentError
from gsstream.core.hierarchy import Hierarchy
from gsstream.engine.assembly.checks import Checks
from gsstream.engine.assembly.part_in_use import PartInUse, Where
from gsstream.engine.step.optimise import count_dead_gates
from gsstream.parts.gate.always_open import AlwaysOpen

EXTREMES = torch.tensor([-1e4, -100.0, -17.5, -6.9, -1e-30, 0.0, 1e-30, 6.9, 17.5, 100.0, 1e4])


def sampler(**settings: object) -> GumbelSigmoid:
    return GumbelSigmoid(GumbelSigmoid.Config(**settings))


def gradient(part: GumbelSigmoid | BinarySteGate, logits: torch.Tensor) -> torch.Tensor:
    leaf = logits.clone().requires_grad_()
    (found,) = torch.autograd.grad(part.sample(leaf, None).sum(), leaf)
    return found


@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
@pytest.mark.parametrize("levels", [1, 2, 10, 100])
@pytest.mark.parametrize("temperature", [0.01, 0.3, 100.0])
def test_extreme_logits_give_levels_in_every_precision(temperature: float, levels: int, kind: torch.dtype) -> None:
    part = sampler(temperature=temperature, levels=levels)
    logits = EXTREMES.to(kind)
    for noise in (None, torch.full((11,), -17.4), torch.full((11,), 17.4)):
        gates = part.sample(logits, noise)
        assert gates.dtype == kind
        steps = gates.double() * levels
        assert float((steps - steps.round()).abs().max()) <= levels * torch.finfo(kind).eps
        assert 0 <= float(gates.min()) <= float(gates.max()) <= 1
        probability = part.open_probability(logits)
        assert bool(torch.isfinite(probability).all())
        assert 0 <= float(probability.min()) <= float(probability.max()) <= 1
    ends = part.init(EXTREMES.float())
    assert float(ends.abs().max()) == pytest.approx(math.log(1000.0))


@given(st.integers(1, 255), st.floats(0.01, 100), st.floats(-12, 12))
@some(100)
def test_the_decoder_has_the_sampled_value(levels: int, temperature: float, logit: float) -> None:
    """float32: round(g * levels) as a byte, divided by levels again, is g; so is every level in between."""
    part = sampler(levels=levels, temperature=temperature)
    gate = part.sample(torch.tensor([logit, -logit, 0.0]), None)
    byte = torch.round(gate * levels).to(torch.uint8)
    assert torch.equal(byte.float() / torch.tensor(float(levels)), gate)


@pytest.mark.parametrize("levels", [1, 3, 5, 255])
def test_a_tie_between_two_levels_goes_to_the_even_one(levels: int) -> None:
    """An odd number of levels has a tie at logit 0: levels / 2 is half-way."""
    gate = sampler(levels=levels).sample(torch.zeros(1), None)
    assert float(gate * levels) == 2 * round(levels / 4)


@pytest.mark.parametrize("part", [sampler(), BinarySteGate()], ids=["gumbel-sigmoid", "binary-ste"])
def test_an_open_gate_feels_the_images_as_a_closed_one_does(part: GumbelSigmoid) -> None:
    """s (1 - s) is exactly 0 from a logit of 17 temperatures on in float32: a gate at the upper bound (23) was moved
    by the price of openness alone, while one at the lower bound by both."""
    ends = torch.tensor([-math.log(1000.0), math.log(1000.0)])
    down, up = gradient(part, ends).tolist()
    assert up > 0
    assert up == pytest.approx(down, rel=1e-6)
    exact = 1 / (0.3 * (2 + 2 * math.cosh(math.log(1000.0) / 0.3)))
    assert up == pytest.approx(exact, rel=1e-5)


@given(st.floats(-87, 87, width=32))
@some(60)
def test_the_gate_gradient_is_even_and_above_zero(x: float) -> None:
    at = torch.tensor([x, -x])
    values = sigmoid_derivative(at, torch.sigmoid(at))
    assert values[0] == values[1]
    assert float(values[0]) > 0
    assert float(values[0]) == pytest.approx(1 / (2 + 2 * math.cosh(x)), rel=1e-4)


@pytest.mark.parametrize("uniform", [0.0, 2.0**-24, 0.5, 1 - 2.0**-24])
def test_noise_is_finite_at_the_ends_of_the_generator(uniform: float) -> None:
    u = torch.tensor([uniform])
    assert abs(float(logistic(u))) < 17.5
    assert -3 < float(gumbel(u)) < 17.5


@pytest.mark.parametrize("temperature", [0.01, 0.3, 100.0])
@pytest.mark.parametrize("levels", [1, 10, 255])
def test_calibration_within_four_sigma_at_the_limits_of_the_settings(levels: int, temperature: float) -> None:
    part, count = sampler(levels=levels, temperature=temperature, logit_bound=50.0), 20_000
    for p in (0.01, 0.5, 0.99):
        # The logit that opens with probability p, as far as the bound allows.
        eta = 0.5 / levels
        logit = math.log(p / (1 - p)) + temperature * math.log(eta / (1 - eta))
        logits = part.bound(torch.full((count,), logit))
        expected = float(part.open_probability(logits)[0])
        drawn = part.sample(logits, part.noise(count, torch.Generator().manual_seed(levels)))
        share = float((drawn > 0).double().mean())
        assert abs(share - expected) <= 4 * math.sqrt(max(expected * (1 - expected), 1 / count) / count)


def test_dead_gates_are_counted_and_there_are_none_by_default() -> None:
    spread = torch.linspace(-50, 50, 101)
    default = sampler()
    assert count_dead_gates(default, default.init(spread)) == 0
    # With a bound of 50 and a cold gate the far logits are out of reach of images and price: float32 spacing at 1.
    cold = sampler(logit_bound=50.0, temperature=0.01)
    probability = 1 / (2 + 2 * torch.cosh(spread.double() - 0.01 * math.log(0.05 / 0.95)))
    image = 1 / (0.01 * (2 + 2 * torch.cosh(spread.double() / 0.01)))
    expected = int(((probability < 2.0**-24) & (image < 2.0**-24)).sum())
    assert count_dead_gates(cold, cold.init(spread)) == expected > 50
    assert count_dead_gates(AlwaysOpen(), spread) == 0
    assert count_dead_gates(default, torch.zeros(0)) == 0


def test_double_precision_agrees_with_single() -> None:
    logits = torch.linspace(-20, 20, 401)
    for part in (sampler(), BinarySteGate()):
        single, double = gradient(part, logits), gradient(part, logits.double())
        torch.testing.assert_close(single.double(), double, rtol=3e-5, atol=0)


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
        PartInUse("regularizer", part, Where(3, 5), Checks.FRAME).terms(found)


@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16])
def test_half_precision_inputs_are_summed_in_double(kind: torch.dtype) -> None:
    probability, residual = torch.rand(50).to(kind), torch.randn(4000, 3).to(kind)
    found = terms(probability, residual, 4000)
    exact = terms(probability.double(), residual.double(), 4000)
    assert found == pytest.approx(exact, rel=2 * torch.finfo(kind).eps)
