"""Binary gates: what they are, the gradient, and the collapse that the released clamp causes."""

from __future__ import annotations

import torch
from gsstream_binary_ste.binary import BinarySteGate
from hypothesis import given, settings
from hypothesis import strategies as st

Config = BinarySteGate.Config


@settings(max_examples=100, deadline=None)
@given(z=st.floats(-50, 50, width=32), n=st.floats(-17, 17, width=32))
def test_gates_are_exactly_0_or_1_and_follow_the_sign(z: float, n: float) -> None:
    gate = BinarySteGate().sample(torch.tensor([z]), torch.tensor([n]))
    assert float(gate) == float(torch.tensor([z]) + torch.tensor([n]) > 0)


def test_the_gradient_is_that_of_the_soft_gate() -> None:
    part = BinarySteGate()
    z = torch.linspace(-2, 2, 9, dtype=torch.float64, requires_grad=True)
    (got,) = torch.autograd.grad(part.sample(z, None).sum(), z)
    soft = torch.sigmoid(z.detach() / 0.3)
    assert torch.allclose(got, soft * (1 - soft) / 0.3, rtol=1e-12)
    blocked = BinarySteGate(Config(clamp_gradient=True)).sample(z, None)
    assert torch.equal(torch.autograd.grad(blocked.sum(), z)[0], torch.zeros_like(z))


def open_after_training(part: BinarySteGate) -> tuple[int, int]:
    """(needed, needless) gates open after training: 40 of 200 gates lower the error when open, all have a price."""
    needed = torch.arange(200) % 5 == 0
    logits = part.init(torch.zeros(200)).clone().requires_grad_(True)
    optimiser = torch.optim.Adam([logits], lr=0.1)
    generator = torch.Generator().manual_seed(0)
    for _ in range(150):
        gates = part.sample(logits, part.noise(200, generator))
        error = torch.where(needed, 1 - gates, gates * 0.0).sum()
        price = 0.2 * part.open_probability(logits).sum()
        optimiser.zero_grad()
        (error + price).backward()
        optimiser.step()
        with torch.no_grad():
            logits.copy_(part.bound(logits))
    opened = part.sample(logits.detach(), None) > 0
    return int(opened[needed].sum()), int(opened[~needed].sum())


def test_the_released_clamp_closes_gates_that_are_needed() -> None:
    assert open_after_training(BinarySteGate(Config(clamp_gradient=True))) == (0, 0)
    kept, needless = open_after_training(BinarySteGate())
    assert kept >= 38
    assert needless == 0
