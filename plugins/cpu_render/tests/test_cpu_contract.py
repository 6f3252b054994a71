"""The renderer, the loss and the optimiser keep the contract of their kinds."""

from __future__ import annotations

from gsstream_cpu_render.adam_part import CpuAdam
from gsstream_cpu_render.loss_part import CpuLoss
from gsstream_cpu_render.renderer import CpuRenderer

from gsstream.testing import parametrize_with_checks

PARTS = [CpuRenderer(), CpuRenderer(CpuRenderer.Config(cache_mb=0.0)), CpuLoss(), CpuAdam()]


@parametrize_with_checks(PARTS)
def test_contract(check) -> None:
    check()
