"""Checks that compare gradients see a wrong one, and see nothing in what is rounding alone."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from gsstream_cpu_render.renderer import CpuRenderer
from gsstream_cpu_render.session import CpuSession

from gsstream.parts.render.wrt import LossAndGrad, WrtScene
from gsstream.testing import loss_and_grad
from gsstream.testing.cases import get_case
from gsstream.testing.compare import gradients_equal, relative

EPS = torch.finfo(torch.float32).eps


def test_every_gradient_of_the_cloud_lies_above_the_floor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Below it a check would pass whatever a renderer gives, as it would for the rotation of round Gaussians."""
    above: dict[str, float] = {}

    def record(what: str, got: Any, expected: torch.Tensor, tolerance: float, why: str, *, floor: float) -> None:
        if expected.numel():
            above[what] = float(expected.abs().max()) / floor

    monkeypatch.setattr("gsstream.testing.compare.relative", record)
    loss_and_grad.check_renderer_loss_and_grad_scene(CpuRenderer())
    assert any("quats" in what for what in above)
    assert min(above.values()) > 1, above


def turned(monkeypatch: pytest.MonkeyPatch, factor: float, noise: float) -> None:
    """Let the native body multiply the gradient by the rotation, and add rounding of what cancels in it."""
    right = CpuSession.loss_and_grad

    def spoilt(session: CpuSession, view: int, target: Any, wrt: Any) -> LossAndGrad[Any]:
        found = right(session, view, target, wrt)
        if not isinstance(wrt, WrtScene):
            return found
        terms = float(found.grad.scales.abs().max())
        quats = factor * found.grad.quats
        rounding = noise * EPS * terms * torch.linspace(-1, 1, quats.numel()).reshape(quats.shape)
        return replace(found, grad=replace(found.grad, quats=quats + rounding))

    monkeypatch.setattr(CpuSession, "loss_and_grad", spoilt)


@pytest.mark.parametrize("name", ["cloud", "static"])  # "static" is round
def test_rounding_is_no_alarm(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loss_and_grad, "get_case", lambda _: get_case(name))
    turned(monkeypatch, factor=1.0, noise=4.0)
    loss_and_grad.check_renderer_loss_and_grad_scene(CpuRenderer())


@pytest.mark.parametrize("factor", [-1.0, 0.0, 0.999, 2.0])
def test_a_wrong_gradient_by_the_rotation_is_an_alarm(factor: float, monkeypatch: pytest.MonkeyPatch) -> None:
    turned(monkeypatch, factor, noise=0.0)
    with pytest.raises(AssertionError, match="gradient of quats"):
        loss_and_grad.check_renderer_loss_and_grad_scene(CpuRenderer())


def test_values_below_the_floor_are_measured_by_the_floor() -> None:
    small = torch.tensor([1e-9, -1e-9])
    relative("small", -small, small, 1e-5, "test", floor=1e-3)
    with pytest.raises(AssertionError, match=r"small, as fractions of 1e-09: largest deviation 2 "):
        relative("small", -small, small, 1e-5, "test", floor=1e-12)
    with pytest.raises(AssertionError, match="expected a floor above 0"):
        relative("small", small, small, 1e-5, "test", floor=0.0)


def test_gradients_share_a_floor_and_their_names() -> None:
    large, small = torch.tensor([2.0, -1.0]), torch.tensor([1e-8, 2e-8])
    gradients_equal("scene", {"means": large, "quats": -small}, {"means": large, "quats": small}, 1e-5, "test")
    with pytest.raises(AssertionError, match="scene: gradient of means"):
        gradients_equal("scene", {"means": large + 0.1}, {"means": large}, 1e-5, "test")
    with pytest.raises(AssertionError, match="expected gradients of"):
        gradients_equal("scene", {"means": large}, {"quats": small}, 1e-5, "test")
    with pytest.raises(AssertionError, match="every expected gradient is 0"):
        gradients_equal("scene", {"means": 0 * large}, {"means": 0 * large}, 1e-5, "test")
