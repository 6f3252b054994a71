"""``first_frame.noise``: centres are disturbed while frame 0 is fitted, and gradients pass to where they are."""

from __future__ import annotations

import pytest
import torch

from gsstream.core.gaussians import Gaussians
from gsstream.engine.frame0.optimise import FirstFrameRun
from gsstream.recipe.model import FirstFrame

NUMBER = 20_000


def disturbed(noise: float, seed: int = 0) -> tuple[Gaussians[torch.Tensor], Gaussians[torch.Tensor]]:
    rows = Gaussians(
        means=torch.zeros(NUMBER, 3, requires_grad=True), quats=torch.ones(NUMBER, 4), scales=torch.zeros(NUMBER, 3),
        opacities=torch.zeros(NUMBER), sh0=torch.zeros(NUMBER, 1, 3), shN=torch.zeros(NUMBER, 0, 3),
    )  # fmt: skip
    run = object.__new__(FirstFrameRun)
    run.settings, run.extent = FirstFrame(noise=noise), 2.0
    run.generator = torch.Generator().manual_seed(seed)
    return rows, run._disturbed(rows)


def test_noise_has_the_size_that_is_asked_for_and_gradients_pass() -> None:
    rows, noisy = disturbed(0.01)
    moved = noisy.means.detach()
    assert moved.std(0).numpy() == pytest.approx(0.02, rel=0.03), "a hundredth of an extent of two units"
    assert abs(float(moved.mean())) < 3 * 0.02 / (3 * NUMBER) ** 0.5 + 1e-4
    (3 * noisy.means).sum().backward()
    assert torch.equal(rows.means.grad, torch.full((NUMBER, 3), 3.0))
    for name in ("quats", "scales", "opacities", "sh0", "shN"):
        assert getattr(noisy, name) is getattr(rows, name)


def test_noise_is_that_of_the_seed_and_none_without() -> None:
    assert torch.equal(disturbed(0.01)[1].means, disturbed(0.01)[1].means)
    assert not torch.equal(disturbed(0.01)[1].means, disturbed(0.01, seed=1)[1].means)
    rows, same = disturbed(0.0)
    assert same is rows
