"""(1 - w) L1 + w (1 - SSIM), the windows by two passes of one dimension."""

from __future__ import annotations

from typing import Any, final

import torch
from torch.nn.functional import conv2d, max_pool2d

from gsstream.api import Loss, LossTraits

TILE, RADIUS = 16, 5
C1, C2 = 0.01**2, 0.03**2


def blurred(planes: torch.Tensor) -> torch.Tensor:
    """Return [P, H, W] planes seen through an 11 x 11 Gaussian window, sigma 1.5, zeros beyond the border."""
    places = torch.arange(-RADIUS, RADIUS + 1, dtype=planes.dtype)
    window = torch.softmax(-(places**2) / (2 * 1.5**2), 0)
    down = conv2d(planes[:, None], window[None, None, :, None], padding=(RADIUS, 0))
    return conv2d(down, window[None, None, None], padding=(0, RADIUS))[:, 0]


def similarity(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return [H, W, 3]: structural similarity (Wang et al. 2004, as 3DGS has it)."""
    x, y = image.permute(2, 0, 1), target.permute(2, 0, 1)
    mx, my, xx, yy, xy = (blurred(planes) for planes in (x, y, x * x, y * y, x * y))
    over = (2 * mx * my + C1) * (2 * (xy - mx * my) + C2)
    under = (mx * mx + my * my + C1) * ((xx - mx * mx) + (yy - my * my) + C2)
    return (over / under).permute(1, 2, 0)


@final
class ExampleLoss(Loss):
    """The photometric loss of 3DGS (Kerbl et al. 2023) with separable windows.

    A loss is an implementation: all give the same value, so that runs compare. Make yours faster, not different.
    """

    source = "3DGS (Kerbl et al. 2023)"
    traits = LossTraits(takes_bytes=True)

    def prepare(self, target: torch.Tensor) -> Any:
        return target if target.is_floating_point() else target.float() / torch.tensor(255.0)

    def evaluate(
        self, image: torch.Tensor, prepared: Any, dssim: float, tile_mask: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        leaf = image.detach().requires_grad_()
        counted = inside = torch.ones_like(image[..., :1])
        if tile_mask is not None:
            # Windows of the tiles beside see what changed; their own gradient belongs to the call that rendered them.
            beside = max_pool2d(tile_mask[None].to(image.dtype), 3, 1, 1)[0]
            counted, inside = (pixels(mask, image) for mask in (beside, tile_mask.to(image.dtype)))
        with torch.enable_grad():
            per_pixel = (1 - dssim) * (leaf - prepared).abs() + dssim * (1 - similarity(leaf, prepared))
            value = (per_pixel * counted).mean()
            (gradient,) = torch.autograd.grad(value, leaf)
        return value.detach().double(), gradient * inside


def pixels(tiles: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
    """Return [H, W, 1]: the mask of tiles [ceil(H / 16), ceil(W / 16)], pixel by pixel."""
    large = tiles.repeat_interleave(TILE, 0).repeat_interleave(TILE, 1)
    return large[: image.shape[0], : image.shape[1], None]
