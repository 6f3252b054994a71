"""The plugin's sessions on any device, with torch in the place of gsplat's kernels, and tiny methods that use them."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import pytest
import torch
from gsstream_gsplat_render.fused import Fused, FusedAdam, FusedLoss
from gsstream_gsplat_render.kernels import Kernels
from gsstream_gsplat_render.placed import RowKernels
from gsstream_gsplat_render.rig import Rigs
from gsstream_gsplat_render.session import GsplatSession
from gsstream_gsplat_render.tiles import IN_TORCH, TileKernels
from torch_kernels import TORCH_FUSED, TORCH_KERNELS

from gsstream.backend import Loss, RowOptimiser
from gsstream.core.part import PartConfig
from gsstream.parts.backend.base import Renderer
from gsstream.parts.render.session import RenderOutput
from gsstream.testing import MethodUnderTest
from gsstream.testing.pretend import DEVICE, PretendRecorder, kernel

ON_DEVICE = Kernels(*(kernel(getattr(TORCH_KERNELS, field.name)) for field in fields(Kernels)))
TILES_THERE = TileKernels(*(kernel(getattr(IN_TORCH, field.name)) for field in fields(TileKernels)))
ROWS_THERE = RowKernels(*(kernel(getattr(TORCH_FUSED.rows, field.name)) for field in fields(RowKernels)))
FUSED_THERE = Fused(
    DEVICE.type,
    *(
        kernel(getattr(TORCH_FUSED, field.name))
        for field in fields(Fused)
        if field.name not in ("device", "rows", "tiles")
    ),
    rows=ROWS_THERE,
    tiles=TILES_THERE,
)
CPU = torch.device("cpu")
#: The stand-in's formulas give other last bits on the two devices with an older torch.
SAME_BITS = pytest.mark.skipif(
    tuple(map(int, torch.__version__.split("+")[0].split(".")[:2])) < (2, 13),
    reason="asks for the same bits of torch formulas on two devices, which torch has from 2.13 on",
)


RIGS = {"cpu": Rigs(CPU), "pretend": Rigs(DEVICE, PretendRecorder(), TILES_THERE, ROWS_THERE)}


class StandIn(Renderer):
    """``GsplatRenderer`` without a GPU: the same sessions, on the processor or the pretend device."""

    source = "gsplat, its kernels replaced"

    class Config(PartConfig):
        place: str = "cpu"

    @property
    def device(self) -> torch.device:
        return torch.device(self.config.place)

    @property
    def loss(self) -> Loss:
        return FusedLoss(self.fused, super().loss)

    @property
    def optimiser(self) -> RowOptimiser:
        return FusedAdam(self.fused, RIGS[self.device.type].recorder)

    @property
    def fused(self) -> Fused:
        return TORCH_FUSED if self.device == CPU else FUSED_THERE

    def render(self, gaussians: Any, cameras: Any, view: int, background: Any) -> RenderOutput:
        return self.open(gaussians, None, cameras, background).render(view, gaussians)

    def open(self, gaussians: Any, active: Any, cameras: Any, background: Any) -> GsplatSession:
        kernels = TORCH_KERNELS if self.device == CPU else ON_DEVICE
        return GsplatSession(kernels, RIGS[self.device.type], gaussians, active, cameras, background)


def method_on(device: torch.device, name: str = "s2gs-fast") -> MethodUnderTest:
    """Return a method of the contract kit's size whose renderer works on a device."""
    under = MethodUnderTest(name)
    renderer = StandIn(StandIn.Config(place=str(device)))
    under.assembly = replace(under.assembly, renderer=renderer)
    return under


__all__ = ["CPU", "DEVICE", "SAME_BITS", "StandIn", "method_on"]
