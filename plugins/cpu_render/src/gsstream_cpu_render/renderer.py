"""The renderer `cpu` of gsstream: the native rasteriser behind torch's autograd, with its loss and its row optimiser.

Renderer, sessions, loss and optimiser are one bundle: a session takes every target for one of :class:`CpuLoss`, and the
residual optimiser every session for a :class:`CpuSession`, because the engine gives them no others.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import torch
from pydantic import Field

from gsstream.api import Cameras, Gaussians, PartConfig
from gsstream.backend import Change, Loss, Renderer, RenderOutput, RenderSession, RowOptimiser
from gsstream_cpu_render.adam_part import CpuAdam
from gsstream_cpu_render.autograd import differentiable
from gsstream_cpu_render.change import find_change
from gsstream_cpu_render.loss_part import CpuLoss
from gsstream_cpu_render.pool import acquire_rasterizer
from gsstream_cpu_render.session import CpuSession, FullPass
from gsstream_cpu_render.threads import instruction_set
from gsstream_cpu_render.view import Background

MEGABYTE = 1_000_000


@final
class CpuRenderer(Renderer):
    """Fast CPU rasteriser (C++20, SIMD). Float32 only; same semantics as the reference renderer.

    In a session that changes only some rows, projected records and depth-sorted tile lists of all others are cached
    per camera, and only the blocks which active rows touch are rendered and differentiated: image and gradients have
    the same bits as a render of the whole scene.
    """

    source = "3DGS (Kerbl et al. 2023)"

    class Config(PartConfig):
        """Threads: gsstream_cpu_render.threads; instruction set: environment GSSTREAM_ISA."""

        cache_mb: float | None = Field(
            default=None,
            ge=0,
            description="megabytes that the caches of a session's cameras may take together; cameras beyond fill "
            "theirs anew each time (slower, same bits); None: no limit",
        )

    def __init__(self, config: PartConfig | None = None) -> None:
        super().__init__(config)
        instruction_set()  # a wrong GSSTREAM_ISA is an error here, not in the middle of a run

    @property
    def loss(self) -> Loss:
        return CpuLoss()

    @property
    def optimiser(self) -> RowOptimiser:
        return CpuAdam()

    def find_change(self, before: Sequence[torch.Tensor], now: Sequence[torch.Tensor], threshold: float) -> Change:
        return find_change(before, now, threshold)

    def render(
        self, gaussians: Gaussians[torch.Tensor], cameras: Cameras, view: int, background: Background
    ) -> RenderOutput:
        return differentiable(FullPass(acquire_rasterizer(cameras, view, background), None), gaussians, None)

    def open(
        self,
        gaussians: Gaussians[torch.Tensor],
        active: torch.Tensor | None,
        cameras: Cameras,
        background: Background,
    ) -> RenderSession:
        megabytes = self.config.cache_mb
        budget = None if megabytes is None else int(megabytes * MEGABYTE)
        return CpuSession(gaussians=gaussians, active=active, cameras=cameras, background=background, budget=budget)
