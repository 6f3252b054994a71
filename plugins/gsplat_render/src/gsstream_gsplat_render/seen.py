"""Gaussians as one camera sees them."""

from __future__ import annotations

from dataclasses import dataclass

import torch


@dataclass(frozen=True, slots=True)
class Projected:
    """Gaussians as one camera sees them, on the device."""

    visible: torch.Tensor  # [N] bool, it touches the image; of all others gsplat leaves the rest undefined
    means2d: torch.Tensor  # [N, 2] pixels
    depths: torch.Tensor  # [N]
    conics: torch.Tensor  # [N, 3]
    colors: torch.Tensor  # [N, 3]
    opacities: torch.Tensor  # [N]
    radii: torch.Tensor  # [N, 2] int32, half the sides of the box in which it is drawn, pixels
    boxes: torch.Tensor  # [N, 4] int32, that box in tiles, as of ``tiles.find_boxes``
