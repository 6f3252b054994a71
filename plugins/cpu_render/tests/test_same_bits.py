"""Any number of threads gives the same bits: one table of calls, each of which has work for several threads.

Bits, because what was trained becomes symbols: a rounding moves one over its border, and then a run that is resumed on
another number of threads writes another stream.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from cpu_scenes import BACKGROUND, random_splats, rasterizer, upstream
from gsstream_cpu_render.adam_step import step_table
from gsstream_cpu_render.loss import PreparedImage, photometric_loss, tile_shape
from gsstream_cpu_render.renderer import CpuAdam, CpuRenderer
from gsstream_cpu_render.threads import set_num_threads
from test_cpu_fit import VIEW, comparison, values
from test_cpu_pass import CASES, captured, solved
from test_cpu_renderer import rig, scene
from test_native_loss import near_pair

from gsstream.api import Gaussians
from gsstream.backend import AdamState, WrtScene
from gsstream.testing.optimiser import residual_case


def rasterised() -> list[Any]:
    """Large enough for the parallel branches of projection, sort, scatter and both rasters."""
    width, height = 320, 200
    splats = random_splats(40_000, 0, 4)
    splats.scales[:] -= 2.0
    subject = rasterizer(width, height, 300.0)
    made = [*subject.forward(splats), *subject.backward(*upstream(0, width, height)), subject.visible_rows()]
    assert len(made[-1]) > 20_000
    return made


def whole_scene() -> list[Any]:
    """A scene is worked on twice, with a smaller one in between."""

    def fused(rows: Gaussians[torch.Tensor], coloured: bool) -> list[torch.Tensor]:
        session = CpuRenderer().open(rows, None, rig(), BACKGROUND)
        return list(values(session.loss_and_grad(VIEW, comparison(coloured), WrtScene(rows))).values())

    first = fused(scene(), True)
    fused(scene(seed=1, coefficients=1), False)
    return [*first, *fused(scene(), True)]


def residual_table() -> list[Any]:
    code, base, units, matrix = residual_case()
    base, units = base.rows(torch.arange(300).repeat(5)), units.repeat(5)
    table, g = CpuAdam().residual_optimiser(code, base, units, matrix), torch.Generator().manual_seed(5)
    for _ in range(3):
        table.forward(torch.rand(1500, generator=g))
        table.backward(base.map(lambda value: torch.randn(value.shape, generator=g)), 1e-3)
        table.step()
    return [table.latents.detach(), table.matrix]


def iterations_of_a_residual() -> list[Any]:
    solution = solved(*captured(*CASES["edge: rates, rows that leave"]))
    return [solution.logits, *solution.latents.values()]


def adam() -> list[Any]:
    rng = np.random.default_rng(6)
    value = torch.from_numpy(rng.standard_normal((30_000, 3)).astype(np.float32))
    state = AdamState.start(value)
    state.steps.copy_(torch.from_numpy(rng.integers(0, 9, 30_000).astype(np.int32)))
    for _ in range(3):
        step_table("means", value, torch.from_numpy(rng.standard_normal((30_000, 3)).astype(np.float32)), state, 0.01)
    return [value.numpy(), state.steps.numpy()]


def loss() -> list[Any]:
    """The image of all tiles, and the image of some."""
    rng = np.random.default_rng(11)
    image, target = near_pair(rng, 210, 250)
    mask = rng.random(tile_shape(210, 250)) < 0.4
    found = [photometric_loss(image, PreparedImage(target), tile_mask=tiles) for tiles in (None, mask)]
    return [value for each in found for value in (each.value, each.gradient)]


CALLS: list[Callable[[], list[Any]]] = [rasterised, whole_scene, residual_table, iterations_of_a_residual, adam, loss]


@pytest.mark.parametrize("call", CALLS, ids=lambda call: call.__name__)
def test_any_number_of_threads_gives_the_same_bits(call: Callable[[], list[Any]], isa: str) -> None:
    found = []
    for count in (1, 2, 3, 4, 7):
        set_num_threads(count)
        found.append([np.asarray(value).tobytes() for value in call()])
    assert any(any(value) for value in found[0]), "every result is zero"
    assert all(other == found[0] for other in found[1:])
