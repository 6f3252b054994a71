"""The gradient by rigid motions of groups in one native call: the bits of the calls that it stands for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from gsstream_cpu_render.renderer import CpuRenderer
from test_cpu_fit import BACKGROUND, comparison, some_tiles
from test_cpu_renderer import rig, scene

from gsstream.api import (
    Gaussians,
    GroupTransforms,
    LossAndGrad,
    RenderSession,
    ShapeError,
    ViewTarget,
    WrtRows,
    WrtTransforms,
)
from gsstream.parts.loss.photometric import ReferenceLoss
from gsstream.parts.render.transforms import transform_rows, transform_vjp

ROWS = torch.tensor([1, 2, 5, 8, 11, 13, 17])


def opened() -> tuple[RenderSession, Gaussians[torch.Tensor]]:
    whole = scene()
    return CpuRenderer().open(whole, ROWS, rig(), BACKGROUND), whole.rows(ROWS)


def moves(seed: int = 5, groups: int = 3, size: float = 0.3) -> GroupTransforms[torch.Tensor]:
    """Groups of which the last one has no row."""
    rng = np.random.default_rng(seed)
    place = np.arange(len(ROWS)) % (groups - 1)
    values = (size * rng.standard_normal((groups, 3)) for _ in range(3))
    return GroupTransforms(np.arange(len(ROWS)), place, *values).map(torch.from_numpy)


def fused(
    given: GroupTransforms[torch.Tensor], wanted: ViewTarget, curvature: bool = False
) -> LossAndGrad[torch.Tensor]:
    session, rows = opened()
    return session.loss_and_grad(1, wanted, WrtTransforms(rows, given, curvature))


def by_rows(given: GroupTransforms[torch.Tensor], wanted: ViewTarget) -> tuple[torch.Tensor, torch.Tensor]:
    """Loss and gradient of the rows after they moved, passed on to their transforms."""
    session, rows = opened()
    there = transform_rows(rows, given)
    leaves = there.map(lambda value: value.clone().requires_grad_())
    found = session.loss_and_grad(1, wanted, WrtRows(leaves))
    for (_, leaf), (_, gradient) in zip(leaves.items(), found.grad.items(), strict=True):
        leaf.grad = gradient
    return found.loss, transform_vjp(leaves, given)


@pytest.mark.parametrize("size", [0.0, 1e-6, 0.3, 4.0])
@pytest.mark.parametrize("coloured", [False, True])
def test_transforms_have_the_bits_of_rows_that_moved(size: float, coloured: bool, threads: int) -> None:
    wanted, given = comparison(coloured), moves(size=size)
    found, (loss, grad) = fused(given, wanted), by_rows(given, wanted)
    assert found.loss == loss
    assert torch.equal(found.grad, grad)
    assert size > 1 or float(grad[:2].abs().max()) > 0
    assert not grad[2].any(), "a group without rows has a gradient of 0"


@pytest.mark.parametrize("coloured", [False, True])
@pytest.mark.parametrize("some", [False, True])
def test_curvature_is_that_of_the_default_body(coloured: bool, some: bool, threads: int) -> None:
    """Of the picture as its camera records it, in the tiles that count; the gradient has the same bits as without."""
    wanted, given = replace(comparison(coloured), tile_weights=some_tiles() if some else None), moves()
    found = fused(given, wanted, curvature=True)
    assert found.curvature is not None
    assert torch.equal(found.grad, by_rows(given, wanted)[1])
    session, rows = opened()
    want = RenderSession.loss_and_grad(session, 1, wanted, WrtTransforms(rows, given, True)).curvature
    np.testing.assert_allclose(found.curvature.numpy(), want.numpy(), atol=1e-4 * float(want.abs().max()))
    assert float(want[:2].abs().max()) > 0
    assert not found.curvature[2].any(), "a group without rows has a curvature of 0"


def test_a_fault_is_named_by_the_default_body() -> None:
    far = moves()._replace(translation=torch.full((3, 3), 1e39, dtype=torch.float64))
    with pytest.raises(ShapeError, match="positions beyond the range of float32"):
        fused(far, comparison())


def test_other_losses_and_wide_sessions_take_the_default_body() -> None:
    wanted, given = comparison(), moves()
    other = replace(wanted, loss=ReferenceLoss(), prepared=ReferenceLoss().prepare(wanted.image))
    session, rows = opened()
    want = RenderSession.loss_and_grad(session, 1, other, WrtTransforms(rows, given))
    assert torch.equal(fused(given, other).grad, want.grad)
    whole = scene()
    every = moves()._replace(rows=torch.arange(len(whole)), group=torch.arange(len(whole)) % 2)
    wide = CpuRenderer().open(whole, None, rig(), BACKGROUND)
    found = wide.loss_and_grad(1, wanted, WrtTransforms(whole, every))
    assert torch.equal(found.grad, RenderSession.loss_and_grad(wide, 1, wanted, WrtTransforms(whole, every)).grad)
