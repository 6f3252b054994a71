"""What is visible in marked tiles: read from the cache, and held against the answer by differentiation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from cpu_scenes import BACKGROUND, HEIGHT, WIDTH, camera, random_splats
from gsstream_cpu_render.rasterizer import NumpyRasterizer
from gsstream_cpu_render.renderer import CpuRenderer

from gsstream.api import Cameras, Gaussians, InputError, ShapeError
from gsstream.backend import RenderSession, ScatterSession
from gsstream.parts.backend.reference import ReferenceRenderer, footprint_in_image

Scene = Gaussians[torch.Tensor]
N = 150
EVEN = (80, 48)  # whole blocks of 4 x 4 pixels
ODD = (WIDTH, HEIGHT)


def rig(size: tuple[int, int]) -> Cameras:
    viewmat, K = camera(*size)
    second = viewmat.copy()
    second[0, 3] = 0.4
    return Cameras(("a", "b"), np.stack([viewmat, second]), np.stack([K, K]), *size)


def scene(seed: int = 0, opaque: bool = True) -> Scene:
    return Gaussians(*(torch.from_numpy(a) for a in random_splats(N, seed, 4, opaque)))


def opened(whole: Scene, size: tuple[int, int] = EVEN, megabytes: float | None = None) -> RenderSession:
    return CpuRenderer(CpuRenderer.Config(cache_mb=megabytes)).open(whole, None, rig(size), BACKGROUND)


def differentiated(whole: Scene, size: tuple[int, int] = EVEN) -> RenderSession:
    return ScatterSession(CpuRenderer(), whole, None, rig(size), BACKGROUND)


def masks(size: tuple[int, int], seed: int = 0) -> list[torch.Tensor]:
    """All tiles, a third of them, and each tile of a row alone."""
    shape = -(-size[1] // 16), -(-size[0] // 16)
    g = torch.Generator().manual_seed(seed)
    single = [torch.zeros(shape, dtype=torch.bool) for _ in range(shape[1])]
    for column, mask in enumerate(single):
        mask[shape[0] // 2, column] = True
    return [torch.ones(shape, dtype=torch.bool), torch.rand(shape, generator=g) < 0.3, *single]


@pytest.mark.parametrize("seed", range(4))
def test_it_is_what_differentiation_finds(seed: int, threads: int) -> None:
    """The same kernel draws for both, so nothing may differ; opaque scenes hide rows behind others."""
    whole = scene(seed)
    session, truth = opened(whole), differentiated(whole)
    for view in (0, 1):
        for mask in masks(EVEN, seed):
            assert torch.equal(session.visible(view, mask), truth.visible(view, mask))


def test_it_agrees_with_the_reference_renderer() -> None:
    """But for rows that add almost nothing: their alpha or transmittance may lie at its bound."""
    whole = scene(1)
    session = opened(whole)
    truth = ReferenceRenderer().open(whole.map(torch.Tensor.double), None, rig(EVEN), BACKGROUND)
    for view in (0, 1):
        for mask in masks(EVEN):
            differing = session.visible(view, mask) != truth.visible(view, mask)
            assert int(differing.sum()) <= 1


def test_border_blocks_are_counted_whole() -> None:
    """In an image of 49 x 37 pixels the last blocks reach three pixels beyond each edge."""
    for seed in range(6):
        whole = scene(seed)
        got, drawn = (f(whole, ODD).visible(0, masks(ODD)[0]) for f in (opened, differentiated))
        assert not bool((drawn & ~got).any()), "a row that adds light was left out"
        beyond = replace(rig(ODD), width=52, height=40)
        assert not bool((got & ~footprint_in_image(whole, beyond, 0)).any())


def test_neither_colour_nor_symmetry_nor_clamped_alpha_hides_a_row() -> None:
    """A black row on black and one right on a pixel's centre have no screen gradient; both are drawn."""
    size, viewmat = (32, 32), np.eye(4)
    viewmat[2, 3] = 3.0
    K = np.array([[50.0, 0, 24.5], [0, 50.0, 24.5], [0, 0, 1]])
    cameras = Cameras(("a",), viewmat[None], K[None], *size)
    one = Gaussians(
        torch.zeros(1, 3),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.full((1, 3), -9.0),
        torch.full((1,), 14.0),
        torch.full((1, 1, 3), -3.0),
        torch.zeros(1, 0, 3),
    )
    for renderer in (CpuRenderer(), ReferenceRenderer()):
        session = renderer.open(one, None, cameras, (0.0, 0.0, 0.0))
        assert not bool((session.screen_gradient(0, torch.ones(32, 32, 3)).gradient != 0).any())
        assert session.visible(0, torch.tensor([[False, False], [False, True]])).tolist() == [True]
        assert session.visible(0, torch.tensor([[True, True], [True, False]])).tolist() == [False]


def test_what_lies_behind_a_wall_is_not_visible() -> None:
    """Three nearly opaque sheets leave a transmittance far below 1e-4."""
    n = 4
    depths = torch.tensor([-1.0, -0.9, -0.8, 0.5])
    whole = Gaussians(
        torch.stack([torch.zeros(n), torch.zeros(n), depths], 1),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        torch.tensor([[2.0, 2.0, -6.0]] * 3 + [[-3.0] * 3]),
        torch.full((n,), 6.0),
        torch.zeros(n, 1, 3),
        torch.zeros(n, 0, 3),
    )
    for each in (opened(whole), differentiated(whole)):
        assert each.visible(0, masks(EVEN)[0]).tolist()[3] is False
        assert each.visible(0, masks(EVEN)[0]).tolist()[0] is True


def test_no_marked_tile_costs_nothing() -> None:
    session = opened(scene())
    assert not bool(session.visible(0, masks(EVEN)[0] & False).any())
    assert session.cache_bytes().total == 0, "the view was drawn although nothing was asked about"


@pytest.mark.parametrize("wrong", [torch.ones(3, 4, dtype=torch.bool), torch.ones(3, 5), torch.ones(48, 80) > 0])
def test_other_tiles_are_refused(wrong: torch.Tensor) -> None:
    for each in (opened(scene()), differentiated(scene())):
        with pytest.raises(ShapeError, match=r"tiles: expected bool \[3, 5\] .* got"):
            each.visible(0, wrong)
    with pytest.raises(ShapeError, match="tile"):
        opened(scene()).visible_anywhere(torch.ones(2, 1, 1, dtype=torch.bool))


def test_the_rasteriser_refuses_tiles_that_it_did_not_draw() -> None:
    rasterizer = NumpyRasterizer(*camera(*EVEN), *EVEN)
    everything = np.ones((3, 5), np.bool_)
    with pytest.raises(InputError, match="expected a forward pass of the whole scene before"):
        rasterizer.contributing_in_cache(everything)
    part = everything.copy()
    part[1] = False
    rasterizer.forward(random_splats(N, 0, 4), tile_mask=part)
    assert rasterizer.contributing_in_cache(part).any()
    with pytest.raises(InputError, match="did not cover"):
        rasterizer.contributing_in_cache(everything)
