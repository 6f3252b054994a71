"""ViewTarget: what a render of one view is compared with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, final

import torch

from gsstream.parts.render.exposure import CameraExposure


class ImageLoss(Protocol):
    """What a session needs of a loss (``gsstream.api.Loss``)."""

    def evaluate(
        self, image: torch.Tensor, prepared: Any, dssim: float, tile_mask: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]: ...


@final
@dataclass(frozen=True, slots=True, eq=False)
class ViewTarget:
    """What a render of one view is compared with.

    Arguments:
        loss: the photometric loss.
        prepared: what its ``prepare`` made of ``image``.
        dssim: weight of 1 - SSIM, 0 to 1.
        image: [H, W, 3] what the camera recorded, float32 or uint8 of which 255 is 1.0; only the curvature of
            transforms reads it.
        exposure: colour map of the camera; None: scene colours are what it records.
        tile_weights: [ceil(H / 16), ceil(W / 16)] float32 factors on the gradients of tiles. A tile of 0 is left out,
            and shows the session's scene as it is. None: every tile counts once.
    """

    loss: ImageLoss
    prepared: Any
    dssim: float
    image: torch.Tensor
    exposure: CameraExposure | None = None
    tile_weights: torch.Tensor | None = None
