"""One call that renders, compares and differentiates, by rows, transforms or a whole scene: as the calls it stands for.

In any order of calls: test_cpu_sessions.py.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from cpu_scenes import relative_error
from gsstream_cpu_render.loss import photometric_loss
from gsstream_cpu_render.renderer import CpuAdam, CpuLoss, CpuRenderer
from numpy.typing import NDArray
from test_cpu_renderer import rig, scene

from gsstream.api import Gaussians, InputError, ShapeError, WrtRows, WrtTransforms
from gsstream.backend import CameraExposure, LossAndGrad, RenderSession, ViewTarget, WrtScene
from gsstream.blocks import GroupTransforms
from gsstream.parts.render.images import TILE
from gsstream.parts.render.transforms import transform_rows, transform_vjp
from gsstream.testing.optimiser import residual_case

BACKGROUND = (0.2, 0.5, 0.9)
ROWS = torch.tensor([1, 2, 5, 8, 11, 13, 17])
VIEW = 1
Found = LossAndGrad[Any]


def opened() -> tuple[RenderSession, Gaussians[torch.Tensor]]:
    """A narrowed session and other values of its rows."""
    whole = scene()
    session = CpuRenderer().open(whole, ROWS, rig(), BACKGROUND)
    g = torch.Generator().manual_seed(3)
    return session, whole.rows(ROWS).map(lambda value: value + 0.1 * torch.randn(value.shape, generator=g))


def wide(coefficients: int = 9) -> tuple[RenderSession, Gaussians[torch.Tensor]]:
    rows = scene(coefficients=coefficients)
    return CpuRenderer().open(rows, None, rig(), BACKGROUND), rows


def moves(seed: int = 5, size: float = 0.3) -> GroupTransforms[torch.Tensor]:
    """Three groups of which the last has no row."""
    rng = np.random.default_rng(seed)
    values = (size * rng.standard_normal((3, 3)) for _ in range(3))
    return GroupTransforms(np.arange(len(ROWS)), np.arange(len(ROWS)) % 2, *values).map(torch.from_numpy)


def comparison(coloured: bool = False) -> ViewTarget:
    cameras, g = rig(), torch.Generator().manual_seed(4)
    image = torch.rand(cameras.height, cameras.width, 3, generator=g)
    matrix, offset = torch.eye(3) + 0.2 * torch.rand(3, 3, generator=g), 0.1 * torch.rand(3, generator=g)
    exposure = CameraExposure(matrix, offset) if coloured else None
    return ViewTarget(CpuLoss(), CpuLoss().prepare(image), 0.2, image, exposure)


def some_tiles(seed: int = 6) -> torch.Tensor:
    """Factors of tiles, about half of them 0, the others unlike one another."""
    cameras, g = rig(), torch.Generator().manual_seed(seed)
    shape = -(-cameras.height // TILE), -(-cameras.width // TILE)
    return torch.rand(shape, generator=g).sub(0.5).clamp(min=0) * 4


#: Name of what a loss is differentiated by -> a session, and the variables that it is asked for.
WRT: dict[str, Callable[[], tuple[RenderSession, Any]]] = {
    "rows": lambda: (opened()[0], WrtRows(opened()[1])),
    "transforms": lambda: (opened()[0], WrtTransforms(opened()[1], moves(), curvature=True)),
    "scene of degree 0": lambda: (wide(1)[0], WrtScene(wide(1)[1])),
    "scene": lambda: (wide()[0], WrtScene(wide()[1])),
    "scene of degree 3": lambda: (wide(16)[0], WrtScene(wide(16)[1])),
}


def fused(by: str, wanted: ViewTarget) -> Found:
    session, asked = WRT[by]()
    return session.loss_and_grad(VIEW, wanted, asked)


def default(by: str, wanted: ViewTarget) -> Found:
    """The same by the body that every session has."""
    session, asked = WRT[by]()
    return RenderSession.loss_and_grad(session, VIEW, wanted, asked)


def values(found: Found) -> dict[str, torch.Tensor]:
    """Everything that was found, by name."""
    named = dict(found.grad.items()) if isinstance(found.grad, Gaussians) else {"transforms": found.grad}
    others = {"means2d": found.means2d, "curvature": found.curvature, "exposure": found.exposure}
    return {**named, **{name: value for name, value in others.items() if value is not None}}


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("coloured", [False, True])
@pytest.mark.parametrize("by", WRT)
def test_the_fused_body_is_near_the_default_one(by: str, coloured: bool, weighted: bool, threads: int) -> None:
    """Rows have the bits of the calls where nothing lies behind them: see test_cpu_layers."""
    wanted = replace(comparison(coloured), tile_weights=some_tiles() if weighted else None)
    found, want = fused(by, wanted), default(by, wanted)
    assert float(found.loss) == pytest.approx(float(want.loss), rel=1e-6)
    assert values(found).keys() == values(want).keys()
    assert "exposure" not in values(found) or coloured
    bounds = {"curvature": 1e-4, "transforms": 1e-4}
    for name, value in values(want).items():
        assert value.numel() == 0 or float(value.abs().max()) > 0
        bound = bounds.get(name, 2e-6 if coloured or weighted or by != "rows" else 2e-5)
        assert relative_error(values(found)[name].numpy(), value.numpy()) <= bound, name


def test_a_whole_scene_without_a_colour_map_has_the_bits_of_the_calls() -> None:
    found, want = (each("scene", comparison()) for each in (fused, default))
    assert found.loss == want.loss
    for name, value in values(want).items():
        assert torch.equal(values(found)[name], value), name


@pytest.mark.parametrize("size", [0.0, 1e-6, 0.3, 4.0])
@pytest.mark.parametrize("coloured", [False, True])
def test_transforms_have_the_bits_of_rows_that_moved(size: float, coloured: bool, threads: int) -> None:
    wanted, given = comparison(coloured), moves(size=size)
    session, rows = opened()
    leaves = transform_rows(rows, given).map(lambda value: value.clone().requires_grad_())
    by_rows = session.loss_and_grad(VIEW, wanted, WrtRows(leaves))
    for (_, leaf), (_, gradient) in zip(leaves.items(), by_rows.grad.items(), strict=True):
        leaf.grad = gradient
    for curvature in (False, True):
        found = opened()[0].loss_and_grad(VIEW, wanted, WrtTransforms(rows, given, curvature))
        assert found.loss == by_rows.loss
        assert torch.equal(found.grad, transform_vjp(leaves, given))
        assert size > 1 or float(found.grad[:2].abs().max()) > 0
        assert not found.grad[2].any(), "a group without rows has a gradient of 0"
        assert (found.curvature is not None) == curvature
        assert found.curvature is None or not found.curvature[2].any()


def test_the_colour_maps_gradient_is_that_of_the_loss() -> None:
    """Central differences of each of its twelve numbers. SSIM alone: L1 has corners."""
    wanted = replace(comparison(coloured=True), dssim=1.0)
    gradient = fused("scene", wanted).exposure
    assert gradient is not None
    assert wanted.exposure is not None
    step = 2e-3
    for entry in range(12):
        losses = []
        for sign in (1, -1):
            matrix, offset = wanted.exposure.matrix.clone(), wanted.exposure.offset.clone()
            (matrix.view(-1) if entry < 9 else offset)[entry % 9] += sign * step
            losses.append(float(fused("scene", replace(wanted, exposure=CameraExposure(matrix, offset))).loss))
        assert (losses[0] - losses[1]) / (2 * step) == pytest.approx(float(gradient[entry]), rel=0.02, abs=2e-3), entry


def _of_pixels(statistics: NDArray[np.float32], shape: Sequence[int]) -> NDArray[np.float32]:
    """[2, H, 3 W] of statistics by tile; what tiles hold beyond the image's border is not written."""
    rows, columns, maps, side, floats = statistics.shape
    whole = statistics.transpose(2, 0, 3, 1, 4).reshape(maps, rows * side, columns * floats)
    return whole[:, : shape[0], : 3 * shape[1]]


def test_a_target_knows_its_statistics_where_they_were_needed() -> None:
    """Strip by strip, in any order, they are those that are made in one go."""
    image = comparison().image
    wanted, again = CpuLoss().prepare(image), CpuLoss().prepare(image)
    assert not wanted.statistics[1].any()
    first = fused("rows", ViewTarget(CpuLoss(), wanted, 0.2, image))
    assert wanted.statistics[1].any()
    for prepared in (wanted, again):
        photometric_loss(image.numpy(), prepared, gradient=False)
        assert prepared.statistics[1].all()
    np.testing.assert_array_equal(*(_of_pixels(prepared.statistics[0], image.shape) for prepared in (wanted, again)))
    second = fused("rows", ViewTarget(CpuLoss(), again, 0.2, image))
    assert first.loss == second.loss
    assert all(torch.equal(values(second)[name], value) for name, value in values(first).items())


def weighted(wanted: ViewTarget) -> ViewTarget:
    return replace(wanted, tile_weights=some_tiles())


def _wide_with_moves() -> tuple[RenderSession, WrtTransforms]:
    (session, rows), count = wide(), len(wide()[1])
    return session, WrtTransforms(rows, moves()._replace(rows=torch.arange(count), group=torch.arange(count) % 2))


@pytest.mark.parametrize(
    ("ask", "change"),
    [
        (WRT["scene"], weighted),
        (lambda: (wide()[0], WrtRows(wide()[1])), lambda wanted: wanted),
        (_wide_with_moves, lambda wanted: wanted),
    ],
)
def test_what_the_fused_body_cannot_do_the_default_one_does(ask: Any, change: Any) -> None:
    """Tiles that weigh in a whole scene, and rows or transforms of a session that was not narrowed."""
    wanted = change(comparison())
    session, asked = ask()
    found, want = session.loss_and_grad(VIEW, wanted, asked), RenderSession.loss_and_grad(ask()[0], VIEW, wanted, asked)
    assert found.loss == want.loss
    for name, value in values(want).items():
        assert torch.equal(values(found)[name], value), name


@pytest.mark.parametrize("by", ["rows", "scene"])
@pytest.mark.parametrize("name", ["means", "sh0"])
def test_it_names_a_value_that_is_not_finite(name: str, by: str) -> None:
    session, rows = opened() if by == "rows" else wide()
    getattr(rows, name)[1] = torch.nan
    with pytest.raises(ShapeError, match=f"{name}: expected finite values, got nan at index"):
        session.loss_and_grad(VIEW, comparison(), WrtRows(rows) if by == "rows" else WrtScene(rows))


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(InputError, match="tile_weights"):
        fused("rows", replace(comparison(), tile_weights=torch.ones(2, 2)))
    with pytest.raises(Exception, match="wrong shape"):
        fused("scene", ViewTarget(CpuLoss(), CpuLoss().prepare(torch.zeros(7, 9, 3)), 0.2, torch.zeros(7, 9, 3)))
    session, rows = opened()
    far = moves()._replace(translation=torch.full((3, 3), 1e39, dtype=torch.float64))
    with pytest.raises(ShapeError, match="positions beyond the range of float32"):
        session.loss_and_grad(VIEW, comparison(), WrtTransforms(rows, far))
    session.narrow(torch.tensor([2, 10_000]))
    with pytest.raises(InputError, match="10000"):  # before any view is drawn
        session.fused_views([0, 1], [comparison(), comparison()])


def test_the_residual_table_refuses_gradients_of_other_rows_and_a_step_without_a_backward() -> None:
    code, base, units, matrix = residual_case()
    table = CpuAdam().residual_optimiser(code, base, units, matrix)
    table.forward(torch.ones(300))
    with pytest.raises(ShapeError, match="gradient of means: expected shape"):
        table.backward(base.rows(torch.arange(10)), 0.0)
    with pytest.raises(ShapeError, match="expected a backward before it"):
        table.step()
