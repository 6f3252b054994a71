"""(1 - w) L1 + w (1 - SSIM) in plain torch: the truth for faster implementations.

SSIM is the 3DGS variant: 11 x 11 Gaussian window, sigma 1.5, zero padding, mean over pixels and channels (Kerbl et al.
2023; Wang et al. 2004).
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple, final

import torch
from torch.nn.functional import conv2d

from gsstream.core.deferred import require
from gsstream.core.errors import ShapeError
from gsstream.parts.loss.base import Loss

TILE = 16
WINDOW, SIGMA = 11, 1.5
#: Wang et al.: (0.01 L)^2 and (0.03 L)^2 for values from 0 to L = 1.
C1, C2 = 0.01**2, 0.03**2


class PreparedTarget(NamedTuple):
    """An image [H, W, 3], and mean and variance of its windows, [3, 1, H, W] each."""

    image: torch.Tensor
    mean: torch.Tensor
    variance: torch.Tensor


@final
class ReferenceLoss(Loss):
    """Autograd through a separable SSIM, on the device of the image."""

    source = "3DGS (Kerbl et al. 2023)"

    def prepare(self, target: torch.Tensor) -> Any:
        return prepare_target(target)

    def evaluate(
        self, image: torch.Tensor, prepared: Any, dssim: float, tile_mask: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        leaf = image.detach().requires_grad_()
        with torch.enable_grad():
            absolute, dissimilar = (leaf - prepared.image).abs(), 1 - ssim_map(leaf, prepared)
            value = torch.lerp(absolute, dissimilar, dssim)
            if tile_mask is not None:
                value = value * _pixel_weight(image, _with_neighbours(tile_mask))
            value = value.mean()
            (gradient,) = torch.autograd.grad(value, leaf)
        # Else a pixel is NaN, or the image is so large that its square overflows.
        message = "image: expected finite values of ordinary size, got a loss that is not finite"
        require(value.detach().isfinite(), lambda: ShapeError(message))
        return value.detach().double(), gradient if tile_mask is None else gradient * _pixel_weight(image, tile_mask)


def prepare_target(target: torch.Tensor) -> PreparedTarget:
    """Return what SSIM needs of a target [H, W, 3]."""
    planes = target.permute(2, 0, 1)[:, None]
    mean, square = _windowed(torch.cat([planes, planes * planes])).chunk(2)
    return PreparedTarget(target, mean, square - mean * mean)


def ssim_map(image: torch.Tensor, target: PreparedTarget) -> torch.Tensor:
    """Return [H, W, 3]: structural similarity of an image in [0, 1] to a target."""
    planes, other = image.permute(2, 0, 1)[:, None], target.image.permute(2, 0, 1)[:, None]
    mean, square, product = _windowed(torch.cat([planes, planes * planes, planes * other])).chunk(3)
    both = mean * target.mean
    covariance, energy = product - both, mean * mean
    variances = square - energy + target.variance
    similar = (2 * both + C1) * (2 * covariance + C2)
    return (similar / ((energy + target.mean * target.mean + C1) * (variances + C2)))[:, 0].permute(1, 2, 0)


def _windowed(planes: torch.Tensor) -> torch.Tensor:
    """Weighted means over the window around every pixel of planes [n, 1, H, W]; beyond the border stand zeros."""
    weights = window_weights(planes.device, planes.dtype)
    down = conv2d(planes, weights, padding=(WINDOW // 2, 0))
    return conv2d(down, weights.transpose(2, 3), padding=(0, WINDOW // 2))


@functools.cache
def window_weights(device: torch.device, dtype: torch.dtype) -> torch.Tensor:
    """Return the weights [1, 1, 11, 1] of a window along one axis; kept, so that they cross to a device once."""
    places = torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2
    weights = torch.exp(-0.5 * (places / SIGMA) ** 2)
    return (weights / weights.sum()).to(dtype).to(device)[None, None, :, None]


def _with_neighbours(tile_mask: torch.Tensor) -> torch.Tensor:
    """The windows of pixels in neighbouring tiles see a changed tile: radius 5 is less than a tile."""
    return torch.nn.functional.max_pool2d(tile_mask[None].float(), 3, 1, 1)[0]


def _pixel_weight(image: torch.Tensor, tile_mask: torch.Tensor) -> torch.Tensor:
    height, width = image.shape[:2]
    mask = tile_mask.to(image.dtype).repeat_interleave(TILE, 0).repeat_interleave(TILE, 1)
    return mask[:height, :width, None]
