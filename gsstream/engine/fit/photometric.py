"""What renders of one frame are compared with: the images, by the run's loss, in the colours of each camera."""

from __future__ import annotations

from typing import Any

import torch

from gsstream.core.cameras import Cameras
from gsstream.core.gaussians import Gaussians
from gsstream.engine.fit.frame_images import FrameImages
from gsstream.parts.backend.base import Renderer
from gsstream.parts.render.exposure import Exposure
from gsstream.parts.render.loss import Loss
from gsstream.parts.render.target import ViewTarget


class PhotometricLoss:
    """The photometric loss of one frame's views; ``dssim`` is the weight of 1 - SSIM."""

    def __init__(self, loss: Loss, dssim: float, images: FrameImages, exposure: Exposure | None) -> None:
        self._loss, self._dssim, self.images, self.exposure = loss, dssim, images, exposure
        self._prepared: dict[int, Any] = {}

    def view_target(self, view: int, tile_weights: torch.Tensor | None = None) -> ViewTarget:
        """Return the target that renders of a view are compared with."""
        image = self.images.stored(view)
        if view not in self._prepared:
            self._prepared[view] = self._loss.prepare(image)
        exposure = self.exposure[view] if self.exposure else None
        return ViewTarget(
            loss=self._loss,
            prepared=self._prepared[view],
            dssim=self._dssim,
            image=image,
            exposure=exposure,
            tile_weights=tile_weights,
        )


def render_exposed(
    renderer: Renderer,
    gaussians: Gaussians[torch.Tensor],
    cameras: Cameras,
    view: int,
    background: tuple[float, float, float],
    exposure: Exposure | None,
) -> torch.Tensor:
    """Return [H, W, 3]: a scene as the camera of this view records it; no graph."""
    with torch.no_grad():
        image = renderer.render(gaussians, cameras, view, background).image
    return exposure[view].apply(image) if exposure else image
