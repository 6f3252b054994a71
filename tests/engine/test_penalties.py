"""What Gaussians cost besides their pictures: against automatic differentiation, against pixels, at the extremes."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gsstream.core.cameras import Cameras
from gsstream.core.gaussians import Gaussians
from gsstream.core.picture_size import area_price
from gsstream.engine.fit import constants
from gsstream.engine.frame0.penalties import add_penalty_grad
from gsstream.parts.backend.reference import ReferenceRenderer

SIZE, EXTENT, PRICE = 64, 3.0, 0.01
#: Gradient of an opacity that says that the view drew the row; it is small beside the penalties.
DRAWN = 1e-12


def camera() -> Cameras:
    viewmats = np.eye(4)[None].copy()
    viewmats[0, 2, 3] = 1.0  # it stands one unit behind the origin
    K = np.array([[[80.0, 0, SIZE / 2], [0, 80.0, SIZE / 2], [0, 0, 1.0]]])
    return Cameras(("cam0",), viewmats, K, SIZE, SIZE)


def scene_of(means: torch.Tensor, scales: torch.Tensor, opacities: torch.Tensor) -> Gaussians[torch.Tensor]:
    count = len(means)
    return Gaussians(
        means=means,
        quats=torch.tensor([1.0, 0, 0, 0], dtype=means.dtype).repeat(count, 1),
        scales=scales,
        opacities=opacities,
        sh0=torch.zeros(count, 1, 3),
        shN=torch.zeros(count, 0, 3),
    )


def center_of(scene: Gaussians[torch.Tensor]) -> torch.Tensor:
    return torch.as_tensor(camera().centers[0]).to(scene.means)


def grads(scene: Gaussians[torch.Tensor], price: float) -> tuple[torch.Tensor, torch.Tensor]:
    found = scene.map(torch.zeros_like)
    found.opacities.fill_(DRAWN)
    add_penalty_grad(found, scene, camera(), view=0, center=center_of(scene), extent=EXTENT, area_price=price)
    for name in ("means", "quats", "sh0"):
        assert not getattr(found, name).any()
    return found.scales, found.opacities - DRAWN


def penalty(scene: Gaussians[torch.Tensor], price: float) -> torch.Tensor:
    """The same, written as what is to become small."""
    a, b, c = scene.scales.exp().unbind(1)
    opacity = scene.opacities.sigmoid()
    distance = (scene.means - torch.tensor([0.0, 0.0, -1.0])).norm(dim=1)
    outline = 2 * math.pi * (255 * opacity).clamp_min(1).log() * (a * b + a * c + b * c) / 3
    covered = (outline * (80 / distance) ** 2 / SIZE**2).sum()
    sizes = constants.SCALE_PENALTY * scene.scales.exp().mean() / EXTENT
    return sizes + constants.OPACITY_PENALTY * opacity.mean() + price * covered


@pytest.mark.parametrize("price", [0.0, PRICE])
def test_gradients_are_those_of_the_penalty(price: float) -> None:
    rng = torch.Generator().manual_seed(1)
    draw = [torch.randn(50, columns, generator=rng, dtype=torch.float64) for columns in (3, 3, 1)]
    means, scales, opacities = 3 + draw[0], draw[1] - 4, (2 * draw[2][:, 0]).clamp_min(-5.0)
    scales.requires_grad_()
    opacities.requires_grad_()
    penalty(scene_of(means, scales, opacities), price).backward()
    by_scale, by_opacity = grads(scene_of(means, scales.detach(), opacities.detach()), price)
    assert scales.grad is not None
    assert opacities.grad is not None
    assert torch.allclose(by_scale, scales.grad, rtol=1e-5)
    assert torch.allclose(by_opacity, opacities.grad, rtol=1e-5)


@pytest.mark.parametrize("opacity", [0.05, 0.3, 0.95])
def test_the_price_is_of_the_pixels_that_a_round_gaussian_covers(opacity: float) -> None:
    """The renderer draws it, and its pixels are counted; it widens each by the blur of a pixel."""
    sigma = 4.0
    logit = math.log(opacity / (1 - opacity))
    scene = scene_of(
        torch.tensor([[0.0, 0.0, 3.0]]), torch.full((1, 3), math.log(sigma * 4 / 80)), torch.tensor([logit])
    )
    alpha = ReferenceRenderer().render(scene, camera(), 0, (0.0, 0.0, 0.0)).alpha
    pixels = int((alpha > 0).sum())
    share = float((grads(scene, PRICE)[0] - grads(scene, 0.0)[0]).sum()) / (2 * PRICE)
    assert share * SIZE**2 == pytest.approx(pixels, rel=0.08)


def test_extremes_are_finite_and_cost_no_more_than_the_picture() -> None:
    scene = scene_of(
        torch.tensor([[0.0, 0.0, -1.0], [0, 0, 0], [1e6, 0, 0], [0, 0, -9]]),
        torch.tensor([[-40.0, -40, -40], [20, 20, 20], [0, 0, 0], [3, -30, 3]]),
        torch.tensor([0.0, 60.0, -60.0, 2.0]),
    )
    by_scale, by_opacity = (
        with_price - without for with_price, without in zip(grads(scene, PRICE), grads(scene, 0.0), strict=True)
    )
    assert torch.isfinite(by_scale).all()
    assert torch.isfinite(by_opacity).all()
    assert float(by_scale.max()) <= PRICE * math.log(255) * 1.001
    assert float(by_scale.min()) >= 0
    assert float(by_opacity.max()) <= 1.5 * PRICE
    assert float(by_opacity.min()) >= 0
    assert not by_scale[2].any(), "nobody sees it"


def test_only_what_the_view_drew_pays_for_what_it_covers() -> None:
    scene = scene_of(torch.zeros(2, 3), torch.full((2, 3), -2.0), torch.zeros(2))
    found = scene.map(torch.zeros_like)
    found.opacities[0] = DRAWN
    add_penalty_grad(found, scene, camera(), view=0, center=center_of(scene), extent=EXTENT, area_price=PRICE)
    free = grads(scene, 0.0)
    assert torch.equal(found.scales[1], free[0][1])
    assert torch.equal(found.opacities[1:], free[1][1:])
    assert bool((found.scales[0] > free[0][0]).all())
    assert float(found.opacities[0]) > float(free[1][0])


def test_only_large_pictures_have_a_price() -> None:
    assert area_price(320) == area_price(640) == 0.0
    assert area_price(1280) == area_price(4096) > 0
