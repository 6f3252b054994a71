"""An adapter: whatever draws, in the shape of a renderer."""

from __future__ import annotations

from typing import final

import torch
from pydantic import Field

from gsstream.api import Cameras, Gaussians, PartConfig
from gsstream.backend import Renderer, RenderOutput, ScreenGradient
from gsstream.testing.cases import RENDERER


@final
class ExampleRenderer(Renderer):
    """The reference renderer in another coat; put calls of your library in its place.

    Sessions, masks and caches have defaults that are right and slow: ``gsstream/parts/backend/base.py`` describes
    what to override.
    """

    source = "gsstream"

    class Config(PartConfig):
        gain: float = Field(default=1.0, gt=0, le=4, description="factor on the colours, no unit")

    def render(
        self, gaussians: Gaussians[torch.Tensor], cameras: Cameras, view: int, background: tuple[float, float, float]
    ) -> RenderOutput:
        drawn = RENDERER.render(gaussians, cameras, view, background)
        return RenderOutput(drawn.image * self.config.gain, drawn.alpha)

    def screen_gradient(
        self, gaussians: Gaussians[torch.Tensor], cameras: Cameras, view: int, image_gradient: torch.Tensor
    ) -> ScreenGradient:
        return RENDERER.screen_gradient(gaussians, cameras, view, image_gradient * self.config.gain)
