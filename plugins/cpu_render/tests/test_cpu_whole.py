"""A whole scene rendered, compared and differentiated in one call: as the calls that it stands for."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from cpu_scenes import relative_error
from gsstream_cpu_render.loss_part import CpuLoss
from gsstream_cpu_render.renderer import CpuRenderer
from test_cpu_fit import BACKGROUND, comparison
from test_cpu_renderer import rig, scene

from gsstream.api import (
    CameraExposure,
    Gaussians,
    LossAndGrad,
    RenderSession,
    ShapeError,
    ViewTarget,
    WrtScene,
)
from gsstream.parts.loss.photometric import ReferenceLoss

VIEW = 1


Found = LossAndGrad[Gaussians[torch.Tensor]]


def fused(rows: Gaussians[torch.Tensor], wanted: ViewTarget) -> Found:
    return CpuRenderer().open(rows, None, rig(), BACKGROUND).loss_and_grad(VIEW, wanted, WrtScene(rows))


def by_default_body(rows: Gaussians[torch.Tensor], wanted: ViewTarget) -> Found:
    """The same by the body that every session has."""
    session = CpuRenderer().open(rows, None, rig(), BACKGROUND)
    return RenderSession.loss_and_grad(session, VIEW, wanted, WrtScene(rows))


def values(found: Found) -> dict[str, torch.Tensor]:
    named = {**dict(found.grad.items()), "means2d": found.means2d}
    return named if found.exposure is None else {**named, "exposure": found.exposure}


@pytest.mark.parametrize("coefficients", [1, 4, 16])
@pytest.mark.parametrize("coloured", [False, True])
def test_the_fused_gradient_of_all_is_that_of_the_default_body(coloured: bool, coefficients: int, threads: int) -> None:
    rows, wanted = scene(coefficients=coefficients), comparison(coloured)
    found, want = fused(rows, wanted), by_default_body(rows, wanted)
    assert float(found.loss) == pytest.approx(float(want.loss), rel=1e-6)
    assert values(found).keys() == values(want).keys()
    assert ("exposure" in values(found)) == coloured
    for name, value in values(want).items():
        assert value.numel() == 0 or float(value.abs().max()) > 0
        assert relative_error(values(found)[name].numpy(), value.numpy()) <= 2e-6, name


def test_without_a_colour_map_it_has_the_bits_of_the_calls() -> None:
    found, want = fused(scene(), comparison()), by_default_body(scene(), comparison())
    assert found.loss == want.loss
    for name, value in values(want).items():
        assert torch.equal(values(found)[name], value), name


def test_the_colour_maps_gradient_is_that_of_the_loss() -> None:
    """Central differences of each of its twelve numbers. SSIM alone: L1 has corners."""
    rows, wanted = scene(), replace(comparison(coloured=True), dssim=1.0)
    gradient = fused(rows, wanted).exposure
    assert gradient is not None
    assert wanted.exposure is not None
    step = 2e-3
    for entry in range(12):
        losses = []
        for sign in (1, -1):
            matrix, offset = wanted.exposure.matrix.clone(), wanted.exposure.offset.clone()
            (matrix.view(-1) if entry < 9 else offset)[entry % 9] += sign * step
            losses.append(float(fused(rows, replace(wanted, exposure=CameraExposure(matrix, offset))).loss))
        assert (losses[0] - losses[1]) / (2 * step) == pytest.approx(float(gradient[entry]), rel=0.02, abs=2e-3), entry


def test_other_losses_and_weights_of_tiles_take_the_default_body() -> None:
    rows, wanted = scene(), comparison()
    other = replace(wanted, loss=ReferenceLoss(), prepared=ReferenceLoss().prepare(wanted.image))
    weighted = replace(wanted, tile_weights=torch.ones(-(-rig().height // 16), -(-rig().width // 16)))
    for target in (other, weighted):
        found, want = fused(rows, target), by_default_body(rows, target)
        assert found.loss == want.loss
        for name, value in values(want).items():
            assert torch.equal(values(found)[name], value), name


@pytest.mark.parametrize("name", ["means", "sh0"])
def test_it_names_a_value_that_is_not_finite(name: str) -> None:
    rows = scene()
    getattr(rows, name)[3] = torch.nan
    with pytest.raises(ShapeError, match=f"{name}: expected finite values, got nan at index"):
        fused(rows, comparison())


def test_it_refuses_a_target_of_another_size() -> None:
    wanted = ViewTarget(CpuLoss(), CpuLoss().prepare(torch.zeros(7, 9, 3)), 0.2, torch.zeros(7, 9, 3))
    with pytest.raises(Exception, match="wrong shape"):
        fused(scene(), wanted)
