"""The renderer `gsplat`. What it returns lies on the device of what it is given; it works on a GPU.

Differences from the reference renderer, all of them gsplat's: the Gaussian that would take the transmittance below
1e-4 is not drawn (at most 1e-4 in colour); exponentials are CUDA's fast ones; sums of gradients run in no fixed order,
so two runs differ in the last digits.
"""

from __future__ import annotations

from typing import final

import torch
from pydantic import Field

from gsstream.api import Cameras, Gaussians, PartConfig
from gsstream.backend import Loss, Renderer, RenderOutput, RenderSession, RowOptimiser
from gsstream.replay import ReplayedAdam
from gsstream_gsplat_render.fused import FusedAdam, FusedLoss, load_fused
from gsstream_gsplat_render.kernels import load_kernels
from gsstream_gsplat_render.rig import Background, rigs_on
from gsstream_gsplat_render.session import GsplatSession


@final
class GsplatRenderer(Renderer):
    """CUDA rasteriser through gsplat 1.5; float32 only.

    Raises PluginUnavailable on construction when there is no GPU, no gsplat, or no compiled kernels.
    """

    source = "gsplat (Ye et al. 2024)"

    class Config(PartConfig):
        device: str = Field(default="cuda", pattern=r"^cuda(:\d+)?$", description="the GPU, e.g. cuda or cuda:1")

    def __init__(self, config: PartConfig | None = None) -> None:
        super().__init__(config)
        load_kernels(self.config.device)
        load_fused(self.config.device)

    @property
    def device(self) -> torch.device:
        return torch.device(self.config.device)

    @property
    def loss(self) -> Loss:
        fused = load_fused(self.config.device)
        return super().loss if fused is None else FusedLoss(fused, super().loss)

    @property
    def optimiser(self) -> RowOptimiser:
        fused, recorder = load_fused(self.config.device), rigs_on(self.config.device).recorder
        return ReplayedAdam(recorder) if fused is None else FusedAdam(fused, recorder)

    def render(
        self, gaussians: Gaussians[torch.Tensor], cameras: Cameras, view: int, background: Background
    ) -> RenderOutput:
        return self.open(gaussians, None, cameras, background).render(view, gaussians)

    def open(
        self, gaussians: Gaussians[torch.Tensor], active: torch.Tensor | None, cameras: Cameras, background: Background
    ) -> RenderSession:
        kernels, rigs = load_kernels(self.config.device), rigs_on(self.config.device)
        return GsplatSession(
            kernels=kernels, rigs=rigs, gaussians=gaussians, active=active, cameras=cameras, background=background
        )
