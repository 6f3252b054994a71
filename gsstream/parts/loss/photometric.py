"""(1 - w) L1 + w (1 - SSIM) in plain torch: the truth for faster implementations.

SSIM is the 3DGS variant: 11 x 11 Gaussian window, sigma 1.5, zero padding, mean over pixels and channels (Kerbl et al.
2023). kornia's own padding reflects; on a zero-padded input with "valid" borders it gives the 3DGS value.
"""

from __future__ import annotations

import math
from typing import Any, final

import torch
from kornia.metrics import ssim

from gsstream.core.errors import ShapeError
from gsstream.parts.loss.base import Loss

TILE = 16


@final
class ReferenceLoss(Loss):
    """Autograd through kornia's SSIM; about ten times slower than the rasteriser it judges."""

    source = "3DGS (Kerbl et al. 2023)"

    def prepare(self, target: torch.Tensor) -> Any:
        return target

    def evaluate(
        self, image: torch.Tensor, prepared: Any, dssim: float, tile_mask: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        leaf = image.detach().requires_grad_()
        with torch.enable_grad():
            weight = _pixel_weight(image, None if tile_mask is None else _with_neighbours(tile_mask))
            absolute = ((leaf - prepared).abs() * weight).mean()
            similarity = (ssim_map(leaf, prepared) * weight).mean()
            value = (1 - dssim) * absolute + dssim * (weight.mean() - similarity)
            (gradient,) = torch.autograd.grad(value, leaf)
        if not math.isfinite(float(value.detach())):
            # A NaN pixel, or an image so large that its square overflows.
            raise ShapeError("image: expected finite values of ordinary size, got a loss that is not finite")
        return value.detach().double(), gradient if tile_mask is None else gradient * _pixel_weight(image, tile_mask)


def ssim_map(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return [H, W, 3]: structural similarity of two images in [0, 1]."""
    planes = [torch.nn.functional.pad(x.permute(2, 0, 1)[None], (5, 5, 5, 5)) for x in (image, target)]
    return ssim(planes[0], planes[1], 11, eps=0.0, padding="valid")[0].permute(1, 2, 0)


def _with_neighbours(tile_mask: torch.Tensor) -> torch.Tensor:
    """The windows of pixels in neighbouring tiles see a changed tile: radius 5 is less than a tile."""
    return torch.nn.functional.max_pool2d(tile_mask[None].float(), 3, 1, 1)[0]


def _pixel_weight(image: torch.Tensor, tile_mask: torch.Tensor | None) -> torch.Tensor:
    height, width = image.shape[:2]
    if tile_mask is None:
        return image.new_ones(height, width, 1)
    mask = tile_mask.to(image.dtype).repeat_interleave(TILE, 0).repeat_interleave(TILE, 1)
    return mask[:height, :width, None]
