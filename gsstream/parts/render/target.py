"""ViewTarget: what a render of one view is compared with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import torch

from gsstream.parts.render.exposure import CameraExposure
from gsstream.parts.render.loss import Loss


@final
@dataclass(frozen=True, slots=True, eq=False)
class ViewTarget:
    """What a render of one view is compared with.

    Arguments:
        loss: that of the renderer whose session is given the target.
        prepared: what its ``prepare`` made of ``image``.
        dssim: weight of 1 - SSIM, 0 to 1.
        image: [H, W, 3] what the camera recorded, float32 or uint8 of which 255 is 1.0; only the curvature of
            transforms reads it.
        exposure: colour map of the camera; None: scene colours are what it records.
        tile_weights: [ceil(H / 16), ceil(W / 16)] float32 factors on the gradients of tiles. A tile of 0 is left out,
            and shows the session's scene as it is. None: every tile counts once.
    """

    loss: Loss
    prepared: Any
    dssim: float
    image: torch.Tensor
    exposure: CameraExposure | None = None
    tile_weights: torch.Tensor | None = None
