"""One call that renders, compares and differentiates, and the residual's table: as the calls they stand for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from gsstream_cpu_render.adam_part import CpuAdam
from gsstream_cpu_render.loss import photometric_loss
from gsstream_cpu_render.loss_part import CpuLoss
from gsstream_cpu_render.renderer import CpuRenderer
from numpy.typing import NDArray
from test_cpu_renderer import rig, scene

from gsstream.api import (
    CameraExposure,
    Gaussians,
    InputError,
    LossAndGrad,
    RenderSession,
    ShapeError,
    ViewTarget,
    WrtRows,
)
from gsstream.parts.loss.photometric import ReferenceLoss
from gsstream.parts.render.base import TILE
from gsstream.testing.optimiser.checks import _residual_case

BACKGROUND = (0.2, 0.5, 0.9)
ROWS = torch.tensor([2, 5, 11, 17])


def opened() -> tuple[RenderSession, Gaussians[torch.Tensor]]:
    """A narrowed session and other values of its rows."""
    whole = scene()
    session = CpuRenderer().open(whole, ROWS, rig(), BACKGROUND)
    g = torch.Generator().manual_seed(3)
    return session, whole.rows(ROWS).map(lambda value: value + 0.1 * torch.randn(value.shape, generator=g))


def comparison(coloured: bool = False) -> ViewTarget:
    cameras, g = rig(), torch.Generator().manual_seed(4)
    image = torch.rand(cameras.height, cameras.width, 3, generator=g)
    matrix, offset = torch.eye(3) + 0.2 * torch.rand(3, 3, generator=g), 0.1 * torch.rand(3, generator=g)
    exposure = CameraExposure(matrix, offset) if coloured else None
    return ViewTarget(CpuLoss(), CpuLoss().prepare(image), 0.2, image, exposure)


def fused(session: RenderSession, rows: Gaussians[torch.Tensor], wanted: ViewTarget) -> LossAndGrad:
    return session.loss_and_grad(1, wanted, WrtRows(rows))


def default(session: RenderSession, rows: Gaussians[torch.Tensor], wanted: ViewTarget) -> LossAndGrad:
    """The same by the body that every session has."""
    return RenderSession.loss_and_grad(session, 1, wanted, WrtRows(rows))


def assert_near(found: LossAndGrad, want: LossAndGrad, tolerance: float) -> None:
    assert float(found.loss) == pytest.approx(float(want.loss), rel=1e-6)
    for (name, got), (_, value) in zip(found.grad.items(), want.grad.items(), strict=True):
        assert name == "shN" or float(value.abs().max()) > 0
        np.testing.assert_allclose(
            got.numpy(), value.numpy(), rtol=0, atol=tolerance * float(value.abs().max()), err_msg=name
        )


def test_the_fused_body_is_near_the_default_one(threads: int) -> None:
    """Bit by bit where nothing lies behind the active rows: see test_cpu_layers."""
    assert_near(fused(*opened(), comparison()), default(*opened(), comparison()), 2e-5)


def test_the_fused_body_takes_colour_maps_into_account() -> None:
    assert_near(fused(*opened(), comparison(coloured=True)), default(*opened(), comparison(coloured=True)), 2e-6)


def _of_pixels(statistics: NDArray[np.float32], shape: Sequence[int]) -> NDArray[np.float32]:
    """[2, H, 3 W] of statistics by tile; what tiles hold beyond the image's border is not written."""
    rows, columns, maps, side, floats = statistics.shape
    whole = statistics.transpose(2, 0, 3, 1, 4).reshape(maps, rows * side, columns * floats)
    return whole[:, : shape[0], : 3 * shape[1]]


def test_a_target_knows_its_statistics_where_they_were_needed() -> None:
    """Strip by strip, in any order, they are those that are made in one go."""
    cameras, g = rig(), torch.Generator().manual_seed(4)
    image = torch.rand(cameras.height, cameras.width, 3, generator=g)
    wanted, again = CpuLoss().prepare(image), CpuLoss().prepare(image)
    assert not wanted.statistics[1].any()
    session, rows = opened()
    first = fused(session, rows, ViewTarget(CpuLoss(), wanted, 0.2, image))
    assert wanted.statistics[1].any()
    for prepared in (wanted, again):
        photometric_loss(image.numpy(), prepared, gradient=False)
        assert prepared.statistics[1].all()
    known = [_of_pixels(prepared.statistics[0], image.shape) for prepared in (wanted, again)]
    np.testing.assert_array_equal(*known)
    second = fused(opened()[0], rows, ViewTarget(CpuLoss(), again, 0.2, image))
    assert first.loss == second.loss
    for (_, one), (_, other) in zip(first.grad.items(), second.grad.items(), strict=True):
        assert torch.equal(one, other)


def test_rows_beyond_the_scene_are_refused_for_all_views_at_once() -> None:
    session, _ = opened()
    session.narrow(torch.tensor([2, 10_000]))
    with pytest.raises(InputError, match="10000"):
        session.fused_views([0, 1], [comparison(), comparison()])


def some_tiles(seed: int = 6) -> torch.Tensor:
    """Factors of tiles, about half of them 0, the others unlike one another."""
    cameras, g = rig(), torch.Generator().manual_seed(seed)
    shape = -(-cameras.height // TILE), -(-cameras.width // TILE)
    return torch.rand(shape, generator=g).sub(0.5).clamp(min=0) * 4


@pytest.mark.parametrize("coloured", [False, True])
def test_weights_of_tiles_are_those_of_the_default_body_with_a_mask(coloured: bool, threads: int) -> None:
    wanted = replace(comparison(coloured), tile_weights=some_tiles())
    assert_near(fused(*opened(), wanted), default(*opened(), wanted), 2e-6)


def test_it_refuses_weights_of_another_shape() -> None:
    session, rows = opened()
    with pytest.raises(InputError, match="tile_weights"):
        fused(session, rows, replace(comparison(), tile_weights=torch.ones(2, 2)))


def test_other_losses_and_wide_sessions_take_the_default_body() -> None:
    session, rows = opened()
    wanted = comparison()
    other = replace(wanted, loss=ReferenceLoss(), prepared=ReferenceLoss().prepare(wanted.image))
    for found, want in (
        (fused(session, rows, other), default(*opened(), other)),
        (fused(wide(), scene(), wanted), default(wide(), scene(), wanted)),
    ):
        assert found.loss == want.loss
        for (_, one), (_, value) in zip(found.grad.items(), want.grad.items(), strict=True):
            assert torch.equal(one, value)


def wide() -> RenderSession:
    return CpuRenderer().open(scene(), None, rig(), BACKGROUND)


@pytest.mark.parametrize("name", ["means", "sh0"])
def test_it_names_a_value_that_is_not_finite(name: str) -> None:
    session, rows = opened()
    getattr(rows, name)[1] = torch.nan
    with pytest.raises(ShapeError, match=f"{name}: expected finite values, got nan at index"):
        fused(session, rows, comparison())


def test_the_residual_table_refuses_gradients_of_other_rows_and_a_step_without_a_backward() -> None:
    code, base, units, matrix = _residual_case()
    table = CpuAdam().residual_optimiser(code, base, units, matrix)
    table.forward(torch.ones(300))
    with pytest.raises(ShapeError, match="gradient of means: expected shape"):
        table.backward(base.rows(torch.arange(10)), 0.0)
    with pytest.raises(ShapeError, match="expected a backward before it"):
        table.step()
