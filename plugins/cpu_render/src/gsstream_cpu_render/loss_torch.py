"""The photometric loss as a torch function. Kept apart so that ``loss`` needs no torch."""

from __future__ import annotations

from typing import Any

import torch
from torch.autograd.function import once_differentiable

from gsstream_cpu_render.loss import PhotometricTarget
from gsstream_cpu_render.loss import photometric_loss as evaluate


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: torch.Tensor, target: Any, weight: float, mask: Any, halo: bool) -> torch.Tensor:
        result = evaluate(
            image, target, dssim_weight=weight, tile_mask=mask, gradient=ctx.needs_input_grad[0], halo_gradient=halo
        )
        if result.gradient is not None:
            ctx.save_for_backward(torch.from_numpy(result.gradient))
        return torch.tensor(result.value, dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: torch.Tensor) -> tuple[torch.Tensor, None, None, None, None]:
        (gradient,) = ctx.saved_tensors
        # Mostly the loss itself is differentiated: then the factor is 1 and the image need not be read again.
        scaled = gradient if float(upstream) == 1.0 else gradient * upstream
        return scaled, None, None, None, None


def photometric_loss(
    image: torch.Tensor,
    target: torch.Tensor | PhotometricTarget,
    *,
    dssim_weight: float = 0.2,
    tile_mask: Any | None = None,
    halo_gradient: bool = False,
) -> torch.Tensor:
    """Return the loss as a float32 scalar that can be differentiated once, by ``image`` only.

    Arguments and errors as in ``gsstream_cpu_render.loss.photometric_loss``; tensors live on the CPU. With a mask and
    no ``halo_gradient``, the gradient is 0 outside active tiles.
    """
    loss: torch.Tensor = _Photometric.apply(  # type: ignore[no-untyped-call]
        image, target, dssim_weight, tile_mask, halo_gradient
    )
    return loss
