"""Which rows are drawn in marked tiles, found by differentiating a renderer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch

from gsstream.core.gaussians import Gaussians
from gsstream.parts.render.images import check_tiles, spread_to_pixels
from gsstream.parts.render.session import RenderOutput


def drawn_rows(
    render: Callable[[Gaussians[torch.Tensor]], RenderOutput],
    gaussians: Gaussians[torch.Tensor],
    size: tuple[int, int],
    tiles: torch.Tensor,
) -> torch.Tensor:
    """Find by differentiation the rows drawn in marked tiles: ``RenderSession.visible`` of a differentiable renderer.

    The derivative of the image by the colour of a Gaussian is the sum of its weights alpha * transmittance, which are
    positive where it is drawn and zero elsewhere, so nothing can cancel. All are drawn in grey, because a colour that
    is clamped at 0 has no derivative.

    Arguments:
        render: draws a whole scene; differentiable by its colours. gaussians: the scene, N rows.
        size: (H, W) of the image, pixels. tiles: [ceil(H / 16), ceil(W / 16)] bool.

    Returns:
        [N] bool.

    Raises:
        ShapeError: ``tiles`` of another shape or dtype.
    """
    check_tiles(tiles, size)
    inside = spread_to_pixels(tiles, *size)
    fixed = gaussians.map(torch.Tensor.detach)
    colours = torch.zeros_like(fixed.sh0).requires_grad_()
    with torch.enable_grad():
        image = render(replace(fixed, sh0=colours, shN=torch.zeros_like(fixed.shN))).image
        if not image.requires_grad:  # nothing is drawn at all
            return torch.zeros_like(fixed.opacities, dtype=torch.bool)
        (weights,) = torch.autograd.grad(image, colours, inside[..., None].expand_as(image).to(image))
    return (weights > 0).flatten(1).any(1)
