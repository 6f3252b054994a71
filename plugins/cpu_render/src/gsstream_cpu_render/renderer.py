"""The renderer `cpu` of gsstream: the native rasteriser behind torch's autograd, with its loss and its row optimiser.

Renderer, sessions, loss and optimiser are one bundle: a session takes every target for one of :class:`CpuLoss`, and the
residual optimiser every session for a :class:`CpuSession`, because the engine gives them no others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, final

import torch
from pydantic import Field

from gsstream.api import Cameras, Gaussians, PartConfig
from gsstream.backend import (
    COMPACT_PIXELS,
    AdamState,
    Change,
    JointLayout,
    Loss,
    Renderer,
    RenderOutput,
    RenderSession,
    ResidualOptimiser,
    RowOptimiser,
)
from gsstream_cpu_render.adam_step import step_table
from gsstream_cpu_render.autograd import differentiable
from gsstream_cpu_render.change import find_change
from gsstream_cpu_render.loss import PreparedImage, photometric_loss
from gsstream_cpu_render.pool import acquire_rasterizer
from gsstream_cpu_render.residual import CpuResidualOptimiser
from gsstream_cpu_render.session import CpuSession, FullPass
from gsstream_cpu_render.threads import instruction_set
from gsstream_cpu_render.view import Background

MEGABYTE = 1_000_000


@final
class CpuLoss(Loss):
    """Native (1 - w) L1 + w (1 - SSIM), 3DGS variant; equal to the reference to 1e-6, at a fraction of its time."""

    def prepare(self, target: torch.Tensor) -> Any:
        compact = target.shape[0] * target.shape[1] >= COMPACT_PIXELS
        return PreparedImage(target.detach().numpy(), compact=compact)

    def evaluate(
        self, image: torch.Tensor, prepared: Any, dssim: float, tile_mask: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        mask = None if tile_mask is None else tile_mask.numpy()
        pixels = image.detach().contiguous().numpy()
        result = photometric_loss(pixels, prepared, dssim_weight=dssim, tile_mask=mask, around=True)
        assert result.gradient is not None
        return torch.tensor(result.value, dtype=torch.float64), torch.from_numpy(result.gradient)


@final
class CpuAdam(RowOptimiser):
    """Native and fused: one call per table, threaded where a table is large."""

    def step(
        self,
        values: Mapping[str, torch.Tensor],
        gradients: Mapping[str, torch.Tensor],
        states: Mapping[str, AdamState],
        lrs: Mapping[str, float | torch.Tensor],
    ) -> None:
        for name, gradient in gradients.items():
            step_table(name, values[name].detach(), gradient, state=states[name], lr=lrs[name])

    def residual_optimiser(
        self, code: JointLayout, base: Gaussians[torch.Tensor], units: torch.Tensor, matrix: torch.Tensor
    ) -> ResidualOptimiser[CpuSession]:
        return CpuResidualOptimiser(code, base, units, matrix)


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
