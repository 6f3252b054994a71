"""What renders of one frame are compared with: the images, by the run's loss, in the colours of each camera."""

from __future__ import annotations

from typing import Any

import torch

from gsstream.core.cameras import Cameras
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray
from gsstream.core.storage import packed
from gsstream.parts.loss.base import Loss
from gsstream.parts.render.base import Renderer
from gsstream.parts.render.exposure import Exposure
from gsstream.parts.render.target import ViewTarget


class PhotometricLoss:
    """The photometric loss of one frame's views.

    Arguments:
        loss: the part; dssim: its weight of 1 - SSIM.
        images: [V, H, W, 3] what the cameras recorded. What the loss makes of an image is made when it is first needed.
        exposure: colour maps of the cameras on the device, or None.
        device: where targets are wanted.
    """

    def __init__(
        self, loss: Loss, dssim: float, images: FloatArray, exposure: Exposure | None,
        device: torch.device,
    ) -> None:  # fmt: skip
        self._loss, self._dssim, self._images, self.exposure = loss, dssim, images, exposure
        self._device = device
        self._prepared: dict[int, tuple[torch.Tensor, Any]] = {}

    def view_target(self, view: int, tile_weights: torch.Tensor | None = None) -> ViewTarget:
        """Return what renders of a view are compared with."""
        if view not in self._prepared:
            image = image_on(self._images[view], self._device)
            self._prepared[view] = image, self._loss.prepare(image)
        image, prepared = self._prepared[view]
        exposure = self.exposure[view] if self.exposure else None
        return ViewTarget(self._loss, prepared, self._dssim, image, exposure, tile_weights)


def image_on(image: FloatArray, device: torch.device) -> torch.Tensor:
    """Return an image [H, W, 3] as float32 on a device. It crosses as bytes where these say the same."""
    if device.type == "cpu":
        return torch.from_numpy(image)
    stored = torch.from_numpy(packed(image, "auto")).to(device)
    # Divided by a tensor, as the processor divides: a product with 1 / 255 would be another number.
    return stored if stored.is_floating_point() else stored.float() / stored.new_full((), 255, dtype=torch.float32)


def render_exposed(
    renderer: Renderer, gaussians: Gaussians[torch.Tensor], cameras: Cameras, view: int,
    background: tuple[float, float, float], exposure: Exposure | None,
) -> torch.Tensor:  # fmt: skip
    """Return [H, W, 3]: a scene as the camera of this view records it; no graph."""
    with torch.no_grad():
        image = renderer.render(gaussians, cameras, view, background).image
    return exposure[view].apply(image) if exposure else image
