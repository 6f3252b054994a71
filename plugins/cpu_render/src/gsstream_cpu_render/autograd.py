"""A pass of the native rasteriser as a function that torch can differentiate."""

from __future__ import annotations

from typing import Any

import torch
from torch.autograd.function import once_differentiable

from gsstream.api import ATTRIBUTES, Gaussians
from gsstream.backend import RenderOutput
from gsstream_cpu_render.arrays import as_array, splats_of
from gsstream_cpu_render.pool import Passes


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, passes: Passes, _probe: torch.Tensor | None, *attributes: torch.Tensor) -> Any:
        image, transmittance = passes.forward(splats_of(Gaussians(*attributes)))
        ctx.passes = passes
        ctx.save_for_backward(*attributes)
        ctx.set_materialize_grads(False)
        return torch.from_numpy(image), torch.from_numpy(1.0 - transmittance)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_image: torch.Tensor | None, v_alpha: torch.Tensor | None) -> Any:
        splats = splats_of(Gaussians(*ctx.saved_tensors))  # also proves that they are unchanged since
        if v_image is None and v_alpha is None:
            return (None,) * (2 + len(ATTRIBUTES))
        if v_image is None and v_alpha is not None:
            v_image = torch.zeros(*v_alpha.shape, 3)
        assert v_image is not None
        upstream = None if v_alpha is None else as_array("gradient of alpha", v_alpha.contiguous())
        gradients = ctx.passes.backward(splats, as_array("gradient of the image", v_image.contiguous()), upstream)
        *attributes, means2d = (torch.from_numpy(g) for g in gradients)
        return None, (means2d if ctx.needs_input_grad[1] else None), *attributes


def differentiable(passes: Passes, gaussians: Gaussians[torch.Tensor], probe: torch.Tensor | None) -> RenderOutput:
    """Run the forward of ``passes`` on these Gaussians; torch's backward runs its backward. ``probe``: see render."""
    attributes = [value for _, value in gaussians.items()]
    image, alpha = _Rasterize.apply(passes, probe, *attributes)  # type: ignore[no-untyped-call]
    return RenderOutput(image, alpha)
