"""One view drawn by gsplat's functions, from raw parameters to image and alpha; differentiable."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from gsstream.api import Gaussians
from gsstream_gsplat_render.kernels import Kernels
from gsstream_gsplat_render.rig import Target
from gsstream_gsplat_render.seen import Projected
from gsstream_gsplat_render.tiles import TILE, Grid, tile_lists

BLUR = 0.3  # px^2, added to the 2-D covariance: what gsplat calls eps2d
FAR = 1e10


@dataclass(frozen=True, slots=True)
class Drawn:
    """Image [H, W, 3] and alpha [H, W] on the device; differentiable. ``entries``: of the lists of tiles.

    Where a mask leaves tiles out, the image is the background there, and alpha is what was in the memory before.
    """

    image: torch.Tensor
    alpha: torch.Tensor
    entries: int


def project(
    kernels: Kernels, gaussians: Gaussians[torch.Tensor], view: Target, grid: Grid, probe: torch.Tensor | None = None
) -> Projected:
    """Project raw Gaussians [N], N > 0, that are on the device already; ``probe`` [N, 2] is added to the 2-D means."""
    opacities = gaussians.opacities.sigmoid()
    radii, means2d, depths, conics, _ = kernels.project(
        gaussians.means,
        None,
        gaussians.quats,
        gaussians.scales.exp(),
        view.viewmat,
        view.K,
        view.width,
        view.height,
        eps2d=BLUR,
        near_plane=view.near,
        far_plane=FAR,
        radius_clip=0.0,
        packed=False,
        calc_compensations=False,
        opacities=opacities,
    )
    if probe is not None:
        means2d = means2d + probe[None]
    boxes, visible = grid.boxes(means2d.squeeze(0), radii.squeeze(0))
    colors = _colors(kernels, gaussians, view, visible[None])
    # Squeezed and not indexed: the gradient of a view is a view, that of an index is a copy.
    return Projected(
        visible=visible,
        means2d=means2d.squeeze(0),
        depths=depths.squeeze(0),
        conics=conics.squeeze(0),
        colors=colors.squeeze(0),
        opacities=opacities,
        radii=radii.squeeze(0),
        boxes=boxes,
    )


def composite(kernels: Kernels, seen: Projected, view: Target, mask: torch.Tensor | None = None) -> Drawn:
    """Composite what was projected; with a mask [tile rows + 1, tile columns] in its tiles, else show the background.

    The last row of the mask is not looked at.
    """
    rows, columns = view.tiles
    means2d, radii, depths = seen.means2d[None], seen.radii[None], seen.depths[None]
    _, keys, order = kernels.tiles(means2d, radii, depths, TILE, columns, rows, packed=False, n_images=1)
    offsets = kernels.offsets(keys, 1, columns, rows).reshape(rows, columns)
    wanted = None if mask is None else mask[:rows]
    image, alpha = _rasterized(kernels, seen, view, offsets=offsets, order=order, mask=wanted)
    return Drawn(image, alpha, entries=len(order))


def composite_fixed(
    kernels: Kernels, seen: Projected, view: Target, grid: Grid, mask: torch.Tensor | None = None
) -> Drawn:
    """Composite with lists of fixed size (:mod:`gsstream_gsplat_render.tiles`); nothing is waited for.

    The last row of the mask is False. Where the lists are too short, nothing is drawn, so no gradient is wrong, and the
    grid remembers it.
    """
    lists, wanted = tile_lists(seen.depths, seen.boxes, grid), grid.inside if mask is None else mask
    image, alpha = _rasterized(kernels, seen, view, offsets=lists.offsets, order=lists.order, mask=wanted)
    return Drawn(image, alpha, entries=grid.capacity)


def _rasterized(
    kernels: Kernels,
    seen: Projected,
    view: Target,
    offsets: torch.Tensor,
    order: torch.Tensor,
    mask: torch.Tensor | None,
) -> tuple[torch.Tensor, torch.Tensor]:
    image, alpha = kernels.rasterize(
        seen.means2d[None],
        seen.conics[None],
        seen.colors[None],
        seen.opacities[None],
        view.width,
        view.height,
        TILE,
        offsets[None],
        order,
        backgrounds=view.background,
        masks=None if mask is None else mask[None],
        packed=False,
    )
    return image.squeeze(0), alpha.squeeze((0, 3))


def draw(kernels: Kernels, gaussians: Gaussians[torch.Tensor], view: Target, grid: Grid) -> Drawn:
    """Draw raw Gaussians [N] that are on the device already."""
    if len(gaussians) == 0:
        return _empty(view)
    return composite(kernels, project(kernels, gaussians, view, grid), view)


def pixels(mask: torch.Tensor, view: Target) -> torch.Tensor:
    """A tile mask [rows + 1, columns] as a pixel mask [H, W]."""
    rows, columns = mask.shape
    wide = mask[:, None, :, None].expand(rows, TILE, columns, TILE).reshape(rows * TILE, columns * TILE)
    return wide[: view.height, : view.width]


class Pasted(torch.autograd.Function):
    """Drawn pixels [H, W, 3] where ``inside`` [H, W], others elsewhere.

    The gradient is handed on as it is: in masked tiles the rasteriser does not look at it.
    """

    @staticmethod
    def forward(_ctx: Any, drawn: torch.Tensor, others: torch.Tensor, inside: torch.Tensor) -> torch.Tensor:
        return torch.where(inside[..., None], drawn, others)

    @staticmethod
    def backward(_ctx: Any, *upstream: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        return upstream[0], None, None


def _colors(kernels: Kernels, gaussians: Gaussians[torch.Tensor], view: Target, visible: torch.Tensor) -> torch.Tensor:
    """[1, N, 3] colours max(0, 0.5 + harmonics), seen from the camera."""
    coefficients = torch.cat([gaussians.sh0, gaussians.shN], 1)
    directions = gaussians.means - view.centre
    harmonics = kernels.harmonics(gaussians.sh_degree, directions[None], coefficients[None], masks=visible)
    # clamp_min(0), whose gradient takes three operations: no sum with 0.5 lies between this bound and 0.
    return torch.nn.functional.threshold(harmonics + 0.5, -torch.finfo(torch.float32).tiny, 0.0)


def _empty(view: Target) -> Drawn:
    image = view.background.expand(view.height * view.width, 3).reshape(view.height, view.width, 3).clone()
    return Drawn(image, torch.zeros_like(image[..., 0]), 0)
