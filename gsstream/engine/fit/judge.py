"""How a rendered view is judged: as its camera would have recorded it, against what it did record."""

from __future__ import annotations

from typing import Any

import torch

from gsstream.core.cameras import Cameras
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray
from gsstream.engine.fit.backward import pull_back
from gsstream.engine.fit.exposure import Exposure
from gsstream.loss.base import Loss
from gsstream.render.base import Renderer


class Judge:
    """Compares renders of one frame with its images.

    Arguments:
        loss: the photometric loss; dssim: its weight of 1 - SSIM.
        images: [V, H, W, 3] what the cameras recorded. What the loss makes of an image is made when it is first needed.
        exposure: colour maps of the cameras, or None.
    """

    def __init__(self, loss: Loss, dssim: float, images: FloatArray, exposure: Exposure | None) -> None:
        self._loss, self._dssim, self._images, self.exposure = loss, dssim, images, exposure
        self._targets: dict[int, Any] = {}

    def backward(
        self, view: int, image: torch.Tensor, tiles: torch.Tensor | None = None
    ) -> tuple[float, torch.Tensor]:
        """Judge a render and pull the loss back into whatever it was rendered from.

        Arguments:
            image: [H, W, 3] scene colours, with a graph.
            tiles: the only tiles that what is optimised can change (``RenderOutput.tiles``); None: all.

        Returns:
            The loss, and its gradient [H, W, 3] with respect to the recorded colours.
        """
        if view not in self._targets:
            self._targets[view] = self._loss.prepare(torch.from_numpy(self._images[view]))
        recorded = self.recorded(view, image.detach())
        value, gradient = self._loss.evaluate(recorded, self._targets[view], self._dssim, tiles)
        pull_back([image], [self.exposure.pull(view, gradient) if self.exposure else gradient])
        return value, gradient

    def recorded(self, view: int, image: torch.Tensor) -> torch.Tensor:
        """Return [H, W, 3] scene colours as the camera of this view records them."""
        return self.exposure.apply(view, image) if self.exposure else image


def shown(
    renderer: Renderer, gaussians: Gaussians[torch.Tensor], cameras: Cameras, view: int,
    background: tuple[float, float, float], exposure: Exposure | None,
) -> torch.Tensor:  # fmt: skip
    """Return [H, W, 3]: a scene as the camera of this view records it; no graph.

    Arguments:
        renderer: that draws.
        gaussians: N rows, raw values.
        cameras: training cameras.
        view: index of one of them.
        background: colour behind everything, 0 to 1.
        exposure: colour maps of the cameras, or None.
    """
    with torch.no_grad():
        image = renderer.render(gaussians, cameras, view, background).image
    return exposure.apply(view, image) if exposure else image
