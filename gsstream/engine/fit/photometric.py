"""The images of a frame where they are worked on, and what renders are compared with.

Renders are compared by the run's loss, in the colours of each camera.
"""

from __future__ import annotations

from typing import Any

import torch

from gsstream.core.cameras import Cameras
from gsstream.core.gaussians import Gaussians
from gsstream.parts.backend.base import Renderer
from gsstream.parts.render.exposure import Exposure
from gsstream.parts.render.images import float_image, spread_to_pixels
from gsstream.parts.render.loss import Loss
from gsstream.parts.render.target import ViewTarget


class FrameImages:
    """The images [H, W, 3] of one frame on a device, copied as they are stored when first asked for."""

    def __init__(self, images: Any, device: torch.device) -> None:
        self._images, self.device = images, device
        self._there: dict[int, torch.Tensor] = {}

    def __len__(self) -> int:
        return len(self._images)

    def stored(self, view: int) -> torch.Tensor:
        """Return [H, W, 3] as it is stored: float32, or uint8 of which 255 is 1.0."""
        if view not in self._there:
            self._there[view] = torch.from_numpy(self._images[view]).to(self.device)
        return self._there[view]

    def __getitem__(self, view: int) -> torch.Tensor:
        return float_image(self.stored(view))

    def all_stored(self) -> list[torch.Tensor]:
        """Return the images of all views as they are stored."""
        return [self.stored(view) for view in range(len(self))]


class MixedImages(FrameImages):
    """The images of one frame, and in some tiles those of another: mixed where they are asked for."""

    def __init__(self, images: FrameImages, others: FrameImages, tiles: torch.Tensor) -> None:
        """Take over both; ``tiles`` [V, ceil(H / 16), ceil(W / 16)] bool, where the others are shown."""
        super().__init__(images, images.device)
        self._others, self._tiles = others, tiles

    def stored(self, view: int) -> torch.Tensor:
        if view not in self._there:
            image, other = self._images.stored(view), self._others.stored(view)
            if image.dtype != other.dtype:  # 1.0 is 255 in bytes
                image, other = float_image(image), float_image(other)
            here = spread_to_pixels(self._tiles[view], *image.shape[:2])[..., None]
            self._there[view] = torch.where(here, other, image)
        return self._there[view]


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
