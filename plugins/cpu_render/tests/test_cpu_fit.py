"""One call that renders, compares and differentiates, and the residual's table: as the calls they stand for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from gsstream_cpu_render.adam_part import CpuAdam
from gsstream_cpu_render.loss_part import CpuLoss
from gsstream_cpu_render.renderer import CpuRenderer
from gsstream_cpu_render.threads import num_threads, set_num_threads
from test_cpu_renderer import rig, scene

from gsstream.api import Comparison, Gaussians, InputError, RenderSession, ShapeError
from gsstream.engine.fit.exposure import Exposure
from gsstream.engine.fit.judge import Judge
from gsstream.loss.photometric import ReferenceLoss
from gsstream.render.base import TILE
from gsstream.testing.optimiser.checks import _residual_case

BACKGROUND = (0.2, 0.5, 0.9)
ROWS = torch.tensor([2, 5, 11, 17])


def opened() -> tuple[RenderSession, Gaussians[torch.Tensor]]:
    """A narrowed session and other values of its rows."""
    whole = scene()
    session = CpuRenderer().open(whole, ROWS, rig(), BACKGROUND)
    g = torch.Generator().manual_seed(3)
    return session, whole.rows(ROWS).map(lambda value: value + 0.1 * torch.randn(value.shape, generator=g))


def comparison(coloured: bool = False) -> Comparison:
    cameras, g = rig(), torch.Generator().manual_seed(4)
    target = CpuLoss().prepare(torch.rand(cameras.height, cameras.width, 3, generator=g))
    maps = (torch.eye(3) + 0.2 * torch.rand(3, 3, generator=g), 0.1 * torch.rand(3, generator=g)) if coloured else ()
    return Comparison(CpuLoss(), target, 0.2, *maps)


def step_by_step(
    session: RenderSession, rows: Gaussians[torch.Tensor], wanted: Comparison, view: int = 1
) -> tuple[float, Gaussians[torch.Tensor]]:
    """The same by the calls that the engine makes where there is no short cut."""
    leaves = rows.map(lambda value: value.clone().requires_grad_())
    output = session.render(view, leaves)
    image = output.image.detach()
    if wanted.matrix is not None:
        image = (image.reshape(-1, 3) @ wanted.matrix.T + wanted.offset).reshape(image.shape)
    loss, gradient = CpuLoss().evaluate(image, wanted.target, wanted.dssim, output.tiles)
    if wanted.matrix is not None:
        gradient = (gradient.reshape(-1, 3) @ wanted.matrix).reshape(gradient.shape)
    output.image.backward(gradient)
    return loss, leaves.map(lambda value: value.grad)


def test_pull_is_near_the_calls_it_stands_for(threads: int) -> None:
    """Bit by bit where nothing lies behind the active rows: see test_cpu_layers."""
    session, rows = opened()
    pulled = session.pull(1, rows, comparison())
    loss, gradients = step_by_step(*opened(), comparison())
    assert pulled is not None
    assert pulled.loss == pytest.approx(loss, rel=1e-6)
    assert all(float(value.abs().max()) > 0 for name, value in gradients.items() if name != "shN" or value.numel())
    for (name, got), (_, want) in zip(pulled.gradients.items(), gradients.items(), strict=True):
        np.testing.assert_allclose(got.numpy(), want.numpy(), rtol=0, atol=2e-5 * float(want.abs().max()), err_msg=name)


def test_pull_takes_colour_maps_into_account() -> None:
    session, rows = opened()
    pulled = session.pull(1, rows, comparison(coloured=True))
    loss, gradients = step_by_step(*opened(), comparison(coloured=True))
    assert pulled is not None
    assert pulled.loss == pytest.approx(loss, rel=1e-6)
    for (name, got), (_, want) in zip(pulled.gradients.items(), gradients.items(), strict=True):
        np.testing.assert_allclose(got.numpy(), want.numpy(), rtol=0, atol=2e-6 * float(want.abs().max()), err_msg=name)


def test_a_render_after_a_pull_is_that_of_the_scene() -> None:
    session, rows = opened()
    session.pull(1, rows, comparison())
    fresh, _ = opened()
    assert torch.equal(session.render(1, rows).image, fresh.render(1, rows).image)


def test_a_target_knows_its_statistics_where_they_were_needed() -> None:
    """Strip by strip, in any order, they are those that are made in one go."""
    cameras, g = rig(), torch.Generator().manual_seed(4)
    image = torch.rand(cameras.height, cameras.width, 3, generator=g)
    wanted, again = CpuLoss().prepare(image), CpuLoss().prepare(image)
    assert not wanted.partial[2].any()
    session, rows = opened()
    first = session.pull(1, rows, Comparison(CpuLoss(), wanted, 0.2))
    assert wanted.partial[2].any()
    for got, expected in zip(wanted.statistics, again.statistics, strict=True):
        np.testing.assert_array_equal(got, expected)
    second = opened()[0].pull(1, rows, Comparison(CpuLoss(), again, 0.2))
    assert first.loss == second.loss
    for (_, one), (_, other) in zip(first.gradients.items(), second.gradients.items(), strict=True):
        assert torch.equal(one, other)


def test_rows_beyond_the_scene_are_refused_for_all_views_at_once() -> None:
    session, _ = opened()
    session.narrow(torch.tensor([2, 10_000]))
    with pytest.raises(InputError, match="10000"):
        session.in_one_go([0, 1], [comparison(), comparison()])


def some_tiles(seed: int = 6) -> torch.Tensor:
    """Factors of tiles, about half of them 0, the others unlike one another."""
    cameras, g = rig(), torch.Generator().manual_seed(seed)
    shape = -(-cameras.height // TILE), -(-cameras.width // TILE)
    return torch.rand(shape, generator=g).sub(0.5).clamp(min=0) * 4


@pytest.mark.parametrize("coloured", [False, True])
def test_pull_with_weights_is_the_engines_own_way_with_a_mask(coloured: bool, threads: int) -> None:
    wanted, tiles = comparison(coloured), some_tiles()
    session, rows = opened()
    pulled = session.pull(1, rows, replace(wanted, tiles=tiles))
    other, _ = opened()
    exposure = Exposure(wanted.matrix.expand(2, 3, 3), wanted.offset.expand(2, 3)) if coloured else None
    images = np.stack([np.zeros_like(wanted.target.image), wanted.target.image])
    judged = Judge(CpuLoss(), 0.2, images, exposure).pull(other, 1, rows, tiles)
    assert pulled is not None
    assert pulled.loss == pytest.approx(judged.loss, rel=1e-6)
    for (name, got), (_, want) in zip(pulled.gradients.items(), judged.gradients.items(), strict=True):
        assert name == "shN" or float(want.abs().max()) > 0
        np.testing.assert_allclose(got.numpy(), want.numpy(), rtol=0, atol=2e-6 * float(want.abs().max()), err_msg=name)


def test_the_gradients_of_two_halves_of_the_tiles_add_up_to_that_of_all() -> None:
    """Without SSIM, whose windows look beyond a tile, every pixel speaks for itself."""
    wanted, half = replace(comparison(), dssim=0.0), (some_tiles() > 0).float()
    pulls = []
    for tiles in (None, half, 1 - half):
        session, rows = opened()
        pulls.append(session.pull(1, rows, replace(wanted, tiles=tiles)))
    for (name, whole), (_, one), (_, other) in zip(*(pull.gradients.items() for pull in pulls), strict=True):
        np.testing.assert_allclose((one + other).numpy(), whole.numpy(), rtol=0, atol=1e-5 * float(whole.abs().max()),
                                   err_msg=name)  # fmt: skip


def test_a_pull_without_any_tile_says_nothing_and_leaves_the_session_as_it_was() -> None:
    session, rows = opened()
    pulled = session.pull(1, rows, replace(comparison(), tiles=torch.zeros_like(some_tiles())))
    assert pulled.loss == 0
    assert all(not bool(value.any()) for _, value in pulled.gradients.items())
    fresh, _ = opened()
    assert torch.equal(session.render(1, rows).image, fresh.render(1, rows).image)


def test_pull_refuses_weights_of_another_shape() -> None:
    session, rows = opened()
    with pytest.raises(InputError, match="tile_weights"):
        session.pull(1, rows, replace(comparison(), tiles=torch.ones(2, 2)))


def test_pull_leaves_other_losses_and_wide_sessions_to_the_engine() -> None:
    session, rows = opened()
    wanted = comparison()
    assert session.pull(1, rows, Comparison(ReferenceLoss(), wanted.target, 0.2)) is None
    wide = CpuRenderer().open(scene(), None, rig(), BACKGROUND)
    assert wide.pull(1, scene(), wanted) is None


@pytest.mark.parametrize("name", ["means", "sh0"])
def test_pull_names_a_value_that_is_not_finite(name: str) -> None:
    session, rows = opened()
    getattr(rows, name)[1] = torch.nan
    with pytest.raises(ShapeError, match=f"{name}: expected finite values, got nan at index"):
        session.pull(1, rows, comparison())


def test_the_residual_table_has_the_same_bits_for_any_number_of_threads() -> None:
    code, base, units, matrix = _residual_case()
    base, units = base.rows(torch.arange(300).repeat(5)), units.repeat(5)
    found, before = [], num_threads()
    for number in (1, 2, 3):
        set_num_threads(number)
        table, g = CpuAdam().residual_table(code, base, units, matrix), torch.Generator().manual_seed(5)
        for _ in range(3):
            assert table is not None, "the kernels are older than the plugin: install it again"
            table.rows(torch.rand(1500, generator=g))
            table.pull(base.map(lambda value, g=g: torch.randn(value.shape, generator=g)), 1e-3)
            table.step()
        found.append((table.latents.detach().numpy().tobytes(), table.matrix.numpy().tobytes()))
    set_num_threads(before)
    assert found[0] == found[1] == found[2]


def test_the_residual_table_refuses_gradients_of_other_rows_and_a_step_without_a_pull() -> None:
    code, base, units, matrix = _residual_case()
    table = CpuAdam().residual_table(code, base, units, matrix)
    assert table is not None, "the kernels are older than the plugin: install it again"
    table.rows(torch.ones(300))
    with pytest.raises(ShapeError, match="gradient of means: expected shape"):
        table.pull(base.rows(torch.arange(10)), 0.0)
    with pytest.raises(ShapeError, match="expected a pull before it"):
        table.step()
