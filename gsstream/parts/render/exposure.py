"""Exposure: an affine colour map per training camera, because rigs are rarely colour-matched."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import torch


@final
@dataclass(frozen=True, slots=True, eq=False)
class CameraExposure:
    """Colour map of one camera: recorded = scene @ matrix.T + offset. ``matrix`` [3, 3], ``offset`` [3].

    Channel by channel: on a GPU a product of so narrow matrices took 76 us of an iteration, a multiplication 2.
    """

    matrix: torch.Tensor
    offset: torch.Tensor

    def apply(self, image: torch.Tensor) -> torch.Tensor:
        """Return [H, W, 3]: scene colours as the camera records them."""
        return _mixed(image, self.matrix.T, self.offset)

    def vjp(self, upstream: torch.Tensor) -> torch.Tensor:
        """Return the gradient by scene colours, given that by recorded colours [H, W, 3]."""
        return _mixed(upstream, self.matrix, torch.zeros_like(self.offset))

    def grad(self, image: torch.Tensor, upstream: torch.Tensor) -> torch.Tensor:
        """Return [12]: the gradient by the map, its matrix row by row and its offset.

        ``image`` [H, W, 3] is in scene colours, ``upstream`` [H, W, 3] the gradient by recorded colours.
        """
        pixels, by_pixel = image.reshape(-1, 3), upstream.reshape(-1, 3)
        return torch.cat([(by_pixel.T @ pixels).flatten(), by_pixel.sum(0)])


def _mixed(pixels: torch.Tensor, weights: torch.Tensor, start: torch.Tensor) -> torch.Tensor:
    """``start`` [3] + pixels [H, W, 3] @ weights [3, 3]."""
    mixed = torch.addcmul(start, pixels[..., :1], weights[0])
    return mixed.addcmul_(pixels[..., 1:2], weights[1]).addcmul_(pixels[..., 2:], weights[2])


@final
@dataclass(frozen=True)
class Exposure:
    """Colour maps of C cameras. ``matrix`` [C, 3, 3], ``offset`` [C, 3]."""

    matrix: torch.Tensor
    offset: torch.Tensor

    @staticmethod
    def identity(num_cameras: int) -> Exposure:
        return Exposure(torch.eye(3).repeat(num_cameras, 1, 1), torch.zeros(num_cameras, 3))

    def to(self, device: torch.device) -> Exposure:
        """Return the same maps on a device."""
        return Exposure(self.matrix.to(device), self.offset.to(device))

    def __getitem__(self, view: int) -> CameraExposure:
        return CameraExposure(self.matrix[view], self.offset[view])
