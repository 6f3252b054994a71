"""The native kernels against themselves and against float64, to their bounds.

Set GSSTREAM_TEST_EXAMPLES for more scenes. Instruction sets are those that the processor has.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from numeric_bounds import BOUNDS
from numeric_scenes import camera, draws, random_scene, rendered, upstream, worst

from gsstream.parts.render.reference import ReferenceRenderer

native = pytest.importorskip("gsstream_cpu_render._native", reason="gsstream-cpu-render is not installed")
from gsstream_cpu_render.renderer import CpuRenderer  # noqa: E402


@pytest.fixture(params=native.supported_isas())
def isa(request: pytest.FixtureRequest) -> Iterator[str]:
    """Let a test run with each instruction set that this processor has."""
    before = native.active_isa()
    native.select_isa(request.param)
    yield request.param
    native.select_isa(before)


def test_every_instruction_set_is_within_the_bounds(isa: str) -> None:
    cameras = camera()
    for seed in draws(3):
        scene, grad = random_scene(seed, bases=(1, 4, 9, 16)[seed % 4]), upstream(cameras, seed)
        image, gradients = rendered(CpuRenderer(), scene, cameras, grad)
        want, exact = rendered(ReferenceRenderer(), scene.map(torch.Tensor.double), cameras, grad)
        assert worst(image, want) <= BOUNDS["image (cpu)"].limit
        for (name, got), (_, value) in zip(gradients.items(), exact.items(), strict=True):
            assert worst(got, value) <= BOUNDS["gradients (cpu)"].limit, name


def test_instruction_sets_agree_among_themselves() -> None:
    """Up to rounding: another set sums in another order. Also: an idle rasteriser made for one set is not used for
    another (it was, and every comparison of sets through the renderer compared a set with itself)."""
    cameras, grad = camera(), upstream(camera())
    before = native.active_isa()
    found = {}
    for name in native.supported_isas():
        native.select_isa(name)
        found[name] = rendered(CpuRenderer(), random_scene(5), cameras, grad)
        again, _ = rendered(CpuRenderer(), random_scene(5), cameras, grad)
        assert torch.equal(again, found[name][0]), "an idle object of another set was used"
    native.select_isa(before)
    first_image, first_gradients = next(iter(found.values()))
    for image, gradients in found.values():
        assert worst(image, first_image) < 2e-6
        for (_, a), (_, b) in zip(gradients.items(), first_gradients.items(), strict=True):
            assert worst(a, b) < 2e-5
