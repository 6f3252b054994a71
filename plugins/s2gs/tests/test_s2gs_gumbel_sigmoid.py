"""Gumbel-sigmoid gates: what the paper says of them in numbers, and what the released code does instead."""

from __future__ import annotations

import math

import pytest
import torch
from gsstream_s2gs.gumbel_sigmoid import GumbelSigmoid
from pydantic import ValidationError


def sampler(**settings_: object) -> GumbelSigmoid:
    return GumbelSigmoid(GumbelSigmoid.Config(**settings_))


def test_the_papers_map_from_confidence_to_gate() -> None:
    """Temperature 0.3, one decimal: what each confidence becomes."""
    p = torch.tensor([0.29, 0.30, 0.40, 0.50, 0.60, 0.70, 0.72], dtype=torch.float64)
    gates = sampler().sample(torch.logit(p), None)
    assert [round(float(g), 1) for g in gates] == [0.0, 0.1, 0.2, 0.5, 0.8, 0.9, 1.0]


def test_the_edge_of_the_dead_zone_and_the_papers_threshold() -> None:
    edge = 0.3 * math.log(0.05 / 0.95)
    assert edge == pytest.approx(-0.8833, abs=1e-4)
    gates = sampler().sample(torch.tensor([edge - 1e-4, edge + 1e-4]), None)
    assert gates.tolist() == [0.0, pytest.approx(0.1)]
    alpha = torch.tensor([-2.0, 0.0, 1.5], dtype=torch.float64)
    torch.testing.assert_close(sampler().open_probability(alpha), torch.sigmoid(alpha - edge))


def test_one_gumbel_draw_has_the_law_of_the_released_initialisation() -> None:
    """P(z + n > threshold) = 1 - exp(-exp(z - threshold)) for one draw, whose mean is Euler's constant."""
    n, gate = 200_000, sampler(noise="gumbel")
    drawn = gate.noise(n, torch.Generator().manual_seed(0))
    assert drawn is not None
    assert float(drawn.double().mean()) == pytest.approx(0.5772, abs=4 * math.pi / math.sqrt(6 * n))
    margin = torch.tensor([-3.0, 0.0, 2.0], dtype=torch.float64)
    found = gate.open_probability(margin + 0.3 * math.log(0.05 / 0.95))
    torch.testing.assert_close(found, 1 - torch.exp(-torch.exp(margin)))


def test_nothing_flows_into_the_noise() -> None:
    gate, logits = sampler(), torch.linspace(-3, 3, 40)
    noise = gate.noise(40, torch.Generator().manual_seed(5))
    assert noise is not None
    assert not gate.sample(logits, noise.requires_grad_()).requires_grad


def test_released_clamp_kills_the_gradient_at_the_ends() -> None:
    logits = torch.tensor([-2.0, 0.0, 2.0], requires_grad=True)
    gate = sampler(clamp_gradient=True)
    (gradient,) = torch.autograd.grad(gate.sample(logits, None).sum(), logits)
    assert gradient[0] == gradient[2] == 0
    assert gradient[1] > 0
    assert torch.equal(gate.sample(logits, None), sampler().sample(logits, None))
    binary = torch.linspace(-3, 3, 30).requires_grad_()
    (dead,) = torch.autograd.grad(sampler(levels=1, clamp_gradient=True).sample(binary, None).sum(), binary)
    assert not dead.any()  # the collapse of binary gates in the released code


@pytest.mark.parametrize(
    "bad", [{"temperature": 0.0}, {"levels": 0}, {"levels": 256}, {"noise": "normal"}, {"logit_bound": 0.0}, {"tau": 1}]
)
def test_impossible_settings_are_refused(bad: dict[str, object]) -> None:
    with pytest.raises(ValidationError, match=next(iter(bad))):
        GumbelSigmoid.Config(**bad)
