"""One view drawn by gsplat's functions, from raw parameters to image and alpha; differentiable."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

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
    radii, means2d, depths, conics = _projected(kernels, gaussians, view, opacities)
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


def _projected(
    kernels: Kernels, gaussians: Gaussians[torch.Tensor], view: Target, opacities: torch.Tensor
) -> tuple[torch.Tensor, ...]:
    """Radii [V, N, 2] int32, 2-D means [V, N, 2], depths [V, N] and conics [V, N, 3] of the V views of a target."""
    found: tuple[torch.Tensor, ...] = kernels.project(
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
    return found[:4]


def composite(kernels: Kernels, seen: Projected, view: Target, mask: torch.Tensor | None = None) -> Drawn:
    """Composite what was projected; with a mask [tile rows + 1, tile columns] in its tiles, else show the background.

    The last row of the mask is not looked at.
    """
    lists = _sorted(kernels, seen.means2d[None], seen.radii[None], depths=seen.depths[None], views=view)
    wanted = None if mask is None else mask[: view.tiles[0]]
    return _one(kernels, seen, view, lists=lists, mask=wanted, entries=len(lists[0]))


def composite_fixed(
    kernels: Kernels, seen: Projected, view: Target, grid: Grid, mask: torch.Tensor | None = None
) -> Drawn:
    """Composite with lists of fixed size (:mod:`gsstream_gsplat_render.tiles`); nothing is waited for.

    The last row of the mask is False. Where the lists are too short, nothing is drawn, so no gradient is wrong, and the
    grid remembers it.
    """
    order, offsets = tile_lists(seen.depths, seen.boxes, grid)
    wanted = grid.inside if mask is None else mask
    return _one(kernels, seen, view, lists=(order, offsets[None]), mask=wanted, entries=grid.capacity)


def _rasterized(
    kernels: Kernels,
    view: Target,
    means2d: torch.Tensor,
    conics: torch.Tensor,
    colors: torch.Tensor,
    opacities: torch.Tensor,
    *,
    lists: tuple[torch.Tensor, torch.Tensor],
    background: torch.Tensor,
    mask: torch.Tensor | None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Images [V, H, W, channels] and alpha [V, H, W] of V views.

    ``lists``: entries of the tiles, and [V, rows, columns] where those of each tile begin.
    """
    order, offsets = lists
    image, alpha = kernels.rasterize(
        means2d,
        conics,
        colors,
        opacities,
        view.width,
        view.height,
        TILE,
        offsets,
        order,
        backgrounds=background,
        masks=mask,
        packed=False,
    )
    return image, alpha.squeeze(-1)


def _one(
    kernels: Kernels,
    seen: Projected,
    view: Target,
    lists: tuple[torch.Tensor, torch.Tensor],
    mask: torch.Tensor | None,
    entries: int,
) -> Drawn:
    """The only view of a target."""
    splats = seen.means2d[None], seen.conics[None], seen.colors[None], seen.opacities[None]
    wanted = None if mask is None else mask[None]
    image, alpha = _rasterized(kernels, view, *splats, lists=lists, background=view.background, mask=wanted)
    return Drawn(image.squeeze(0), alpha.squeeze(0), entries)


class Pictures(NamedTuple):
    """V views: image [V, H, W, 3], alpha [V, H, W], and the boxes [V, N, 4] int32 of their Gaussians, in tiles.

    ``entries``: of the longest lists of tiles that one of the views needs.
    """

    image: torch.Tensor
    alpha: torch.Tensor
    boxes: torch.Tensor
    entries: int


def draw_views(kernels: Kernels, gaussians: Gaussians[torch.Tensor], views: Target, grid: Grid) -> Pictures:
    """Draw raw Gaussians [N], N > 0, into all views of a target in one call; nothing is differentiated."""
    with torch.no_grad():
        opacities = gaussians.opacities.sigmoid()
        radii, means2d, depths, conics = _projected(kernels, gaussians, views, opacities)
        boxes, visible = grid.boxes(means2d.flatten(0, 1), radii.flatten(0, 1))
        colors = _colors(kernels, gaussians, views, visible.view(radii.shape[:2]))
        lists = _sorted(kernels, means2d, radii, depths=depths, views=views)
        splats = means2d, conics, colors, opacities.expand(len(colors), -1)
        image, alpha = _rasterized(kernels, views, *splats, lists=lists, background=views.background, mask=None)
        begins = [*lists[1][:, 0, 0].cpu().tolist(), len(lists[0])]
    longest = max(end - begin for begin, end in pairwise(begins))
    return Pictures(image, alpha, boxes.view(*radii.shape[:2], 4), longest)


def rows_in_tiles(
    kernels: Kernels, gaussians: Gaussians[torch.Tensor], views: Target, tiles: torch.Tensor
) -> torch.Tensor:
    """Return [N] bool: which of the raw Gaussians, N > 0, are drawn in the marked tiles of any view.

    The derivative of a picture by the brightness of a Gaussian is the sum of its weights alpha * transmittance, which
    are positive where it is drawn and zero elsewhere, so nothing can cancel.

    Arguments:
        tiles: [V, tile rows, tile columns] bool. Others are not drawn.
    """
    with torch.no_grad():
        opacities = gaussians.opacities.sigmoid()
        radii, means2d, depths, conics = _projected(kernels, gaussians, views, opacities)
        lists, dark = _sorted(kernels, means2d, radii, depths=depths, views=views), torch.zeros_like(views.background)
    brightness = means2d.new_ones(*radii.shape[:2], 1).requires_grad_()
    with torch.enable_grad():
        splats = means2d, conics, brightness, opacities.expand(len(means2d), -1)
        image, _ = _rasterized(kernels, views, *splats, lists=lists, background=dark[:, :1], mask=tiles)
        (weights,) = torch.autograd.grad(image, brightness, torch.ones_like(image))
    return (weights > 0).flatten(2).any(2).any(0)


def _sorted(
    kernels: Kernels, means2d: torch.Tensor, radii: torch.Tensor, depths: torch.Tensor, views: Target
) -> tuple[torch.Tensor, torch.Tensor]:
    """Entries of the tiles of V views, and [V, rows, columns] where those of each tile begin."""
    (rows, columns), count = views.tiles, len(means2d)
    _, keys, order = kernels.tiles(means2d, radii, depths, TILE, columns, rows, packed=False, n_images=count)
    return order, kernels.offsets(keys, count, columns, rows).reshape(count, rows, columns)


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
    """[V, N, 3] colours max(0, 0.5 + harmonics), seen from the cameras."""
    coefficients = torch.cat([gaussians.sh0, gaussians.shN], 1)
    directions = gaussians.means[None] - view.centre
    # Of one view the gradient of an index is a view, that of an expansion a sum.
    every = coefficients[None] if len(directions) == 1 else coefficients.expand(len(directions), -1, -1, -1)
    harmonics = kernels.harmonics(gaussians.sh_degree, directions, every, masks=visible)
    # clamp_min(0), whose gradient takes three operations: no sum with 0.5 lies between this bound and 0.
    return torch.nn.functional.threshold(harmonics + 0.5, -torch.finfo(torch.float32).tiny, 0.0)


def draw_nothing(view: Target) -> Drawn:
    """Draw a scene without a Gaussian."""
    image = view.background.expand(view.height * view.width, 3).reshape(view.height, view.width, 3).clone()
    return Drawn(image, torch.zeros_like(image[..., 0]), 0)
