"""The renderer, with the loss and the row optimiser that it brings, keeps the contract."""

from __future__ import annotations

from gsstream_cpu_render.renderer import CpuRenderer

from gsstream.testing import parametrize_with_checks

PARTS = [CpuRenderer(), CpuRenderer(CpuRenderer.Config(cache_mb=0.0))]


@parametrize_with_checks(PARTS)
def test_contract(check) -> None:
    check()
