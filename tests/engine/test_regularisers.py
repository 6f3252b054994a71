"""What keeps frame 0 from explaining each picture on its own: which rig gets what, and what it does."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from gsstream.core.cameras import Cameras
from gsstream.core.frame import Frame
from gsstream.core.gaussians import SH0, Gaussians
from gsstream.engine.frame0.regularisers import DROPOUT, MOST_OPAQUE, Dropout, Regularisers, choose_regularisers
from gsstream.engine.frame0.smooth_depth import PLACED, SmoothDepth
from gsstream.parts.backend.reference import ReferenceRenderer
from gsstream.parts.render.wrt import NEVER_DRAWN, WrtScene
from gsstream.recipe.model import FirstFrame

SIZE = 24


def rig(views: int) -> Cameras:
    viewmats = np.tile(np.eye(4), (views, 1, 1))
    viewmats[:, 0, 3] = 0.5 * np.arange(views)
    K = np.array([[SIZE, 0, SIZE / 2], [0, SIZE, SIZE / 2], [0, 0, 1.0]])
    return Cameras(tuple(f"cam{i}" for i in range(views)), viewmats, np.tile(K, (views, 1, 1)), SIZE, SIZE)


def wall(depth: torch.Tensor, count: int = 12) -> Gaussians[torch.Tensor]:
    """A grid of opaque Gaussians that fills the picture, each at its depth."""
    steps = (torch.arange(count) + 0.5) / count - 0.5
    y, x = torch.meshgrid(steps, steps, indexing="ij")
    means = torch.stack([x.flatten() * depth, y.flatten() * depth, depth], 1)
    number = count * count
    return Gaussians(
        means=means,
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(number, 1),
        scales=torch.full((number, 3), -2.5),
        opacities=torch.full((number,), 3.0),
        sh0=torch.zeros(number, 1, 3),
        shN=torch.zeros(number, 0, 3),
    )


def ring(views: int) -> Cameras:
    """Cameras around the origin that look at it."""
    angles = 2 * np.pi * np.arange(views) / views
    viewmats = np.tile(np.eye(4), (views, 1, 1))
    viewmats[:, 0, :3] = np.stack([-np.sin(angles), np.cos(angles), 0 * angles], 1)
    viewmats[:, 1, :3] = (0, 0, -1)
    viewmats[:, 2, :3] = np.stack([-np.cos(angles), -np.sin(angles), 0 * angles], 1)
    viewmats[:, 2, 3] = 2.0
    return replace(rig(views), viewmats=viewmats)


@pytest.mark.parametrize(
    ("views", "dropout", "in_line", "in_a_ring"),
    [
        (1, 0.2, 1, 1),
        (2, 0.2, 1, 0),
        (4, 0.2, 1, 0),
        (5, 0.2, 1, 0),
        (6, 0.2, 0, 1),
        (8, 0.2, 0, 1),
        (9, 0, 0, 0),
        (27, 0, 0, 0),
    ],
)
def test_the_cameras_decide_unless_the_recipe_does(views: int, dropout: float, in_line: int, in_a_ring: int) -> None:
    for cameras, smoothness in ((rig(views), in_line), (ring(views), in_a_ring)):
        chosen = choose_regularisers(FirstFrame(), cameras)
        assert (chosen.dropout, chosen.depth_smoothness) == (dropout, smoothness)
    own = choose_regularisers(FirstFrame(few_cameras=False), rig(views))
    assert (own.dropout, own.depth_smoothness) == (0, 0)


def test_smoothness_takes_part_in_every_other_iteration_and_weighs_the_same() -> None:
    chosen = Regularisers(0.0, 3.0)
    weights = [chosen.smoothness_at(iteration, 100) for iteration in range(1, 101)]
    assert weights[:9] == [0] * 9
    assert set(weights[9:]) == {0, 6}
    assert sum(weights) == pytest.approx(3.0 * 92, rel=0.02), "on average what the recipe says, after the first tenth"
    assert choose_regularisers(FirstFrame(), ring(4)).smoothness_at(50, 100) == 0


def test_those_that_stay_make_up_for_those_that_are_left_out() -> None:
    rows = replace(wall(torch.full((144,), 2.0)), opacities=torch.linspace(-4, 6, 144))
    dropout = Dropout(DROPOUT, 7, torch.Generator().manual_seed(0))
    thinned, keep = dropout.thin_out(rows)
    assert keep is not None
    shares = [float(dropout.thin_out(rows)[1].float().mean()) for _ in range(30)]  # type: ignore[union-attr]
    assert np.mean(shares) == pytest.approx(1 - DROPOUT, abs=0.02)
    before, after = rows.opacities.sigmoid(), thinned.opacities.sigmoid()
    torch.testing.assert_close(after, (before / (1 - DROPOUT)).clamp(max=MOST_OPAQUE))
    assert torch.isfinite(thinned.opacities).all()
    fewer = rows.rows(slice(0, 100))
    assert dropout.thin_out(fewer)[1].shape == (100,), "what was drawn for another number of Gaussians is drawn anew"
    drawn = WrtScene(thinned, keep=keep).placed()
    assert (drawn.opacities[~keep] == NEVER_DRAWN).all()
    assert torch.equal(drawn.opacities[keep], thinned.opacities[keep])
    same, none = Dropout(0.0, 7, torch.Generator()).thin_out(rows)
    assert same is rows
    assert none is None


def roughness(rows: Gaussians[torch.Tensor], frame: Frame) -> float:
    """The same sum from depth that is drawn here pixel by pixel, without anything of the module."""
    half = SIZE // 2
    cameras = frame.cameras.scaled(half, half)
    inverse = 0.3 * frame.cameras.extent / rows.means[:, 2]
    shown = replace(rows, sh0=((inverse[:, None].repeat(1, 3) - 0.5) / SH0)[:, None])
    drawn = ReferenceRenderer().render(shown, cameras, 0, (0.0,) * 3)
    depth = (drawn.image[..., 0] / drawn.alpha.clamp_min(0.1)).detach().double().numpy()
    image = frame.images[0].reshape(half, 2, half, 2, 3).mean((1, 3), dtype=np.float64)
    total = 0.0
    for axis in (0, 1):
        edges = np.abs(np.diff(image, axis=axis)).mean(-1)
        total += float((np.abs(np.diff(depth, axis=axis)) * np.exp(-edges / 0.1)).mean())
    return total


def smooth_depth(images: Any) -> SmoothDepth:
    return SmoothDepth(ReferenceRenderer(), Frame(0, 0.0, images, rig(2)), torch.device("cpu"))


def gradient(rows: Gaussians[torch.Tensor], images: Any, weight: float = 1.0) -> Gaussians[torch.Tensor]:
    grad = rows.map(torch.zeros_like)
    smooth_depth(images).add_grad(rows, 0, grad, weight)
    return grad


def test_the_gradient_is_that_of_the_change_of_inverse_depth() -> None:
    order = torch.randperm(144, generator=torch.Generator().manual_seed(2))
    rows = wall(2 + order / 300)  # so far apart in depth that none passes another below
    images = np.random.default_rng(4).random((2, SIZE, SIZE, 3), np.float32)
    frame = Frame(0, 0.0, images, rig(2))
    grad = gradient(rows, images, weight=5.0)
    way = torch.randn(144, generator=torch.Generator().manual_seed(3))
    for name, shift in (("means", way[:, None] * torch.tensor([0.0, 0, 1])), ("opacities", way)):
        step, exact = 1e-4, rows.map(torch.Tensor.double)
        ahead, behind = (
            roughness(replace(exact, **{name: getattr(exact, name) + sign * step * shift}), frame) for sign in (1, -1)
        )
        found = float((getattr(grad, name) * shift).sum())
        assert found == pytest.approx(5 * (ahead - behind) / (2 * step), rel=0.05), name
    assert not grad.sh0.any(), "colours have no part in depth"


def test_an_even_wall_is_smooth_and_an_edge_of_the_picture_allows_a_step() -> None:
    grey = np.full((2, SIZE, SIZE, 3), 0.5, np.float32)
    edge = grey.copy()
    edge[:, :, SIZE // 2 :] = 1.0
    step = torch.where(torch.arange(144) % 12 < 6, 1.5, 3.0)
    even = torch.full((144,), 2.0)
    on_edge, within, flat = (
        float(smooth_depth(images).mean_roughness(wall(depth), 0))
        for depth, images in ((step, edge), (step, grey), (even, grey))
    )
    assert flat < 0.1 * within
    assert on_edge < 0.8 * within, "the other axis has no edge"


def test_nothing_in_view_has_no_gradient() -> None:
    behind = wall(torch.full((144,), -2.0))
    grad = gradient(behind, np.full((2, SIZE, SIZE, 3), 0.5, np.float32))
    assert all(not getattr(grad, name).any() for name in PLACED)
