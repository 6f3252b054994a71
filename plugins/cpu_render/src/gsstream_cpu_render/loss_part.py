"""The photometric loss that the renderer `cpu` brings."""

from __future__ import annotations

from typing import Any, final

import torch

from gsstream.backend import COMPACT_PIXELS, Loss
from gsstream_cpu_render.loss import PreparedImage, photometric_loss


@final
class CpuLoss(Loss):
    """Native (1 - w) L1 + w (1 - SSIM), 3DGS variant; equal to the reference to 1e-6, at a fraction of its time."""

    def prepare(self, target: torch.Tensor) -> Any:
        compact = target.shape[0] * target.shape[1] >= COMPACT_PIXELS
        return PreparedImage(target.detach().numpy(), compact=compact)

    def evaluate(
        self, image: torch.Tensor, prepared: Any, dssim: float, tile_mask: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        mask = None if tile_mask is None else tile_mask.numpy()
        pixels = image.detach().contiguous().numpy()
        result = photometric_loss(pixels, prepared, dssim_weight=dssim, tile_mask=mask, around=True)
        assert result.gradient is not None
        return torch.tensor(result.value, dtype=torch.float64), torch.from_numpy(result.gradient)
