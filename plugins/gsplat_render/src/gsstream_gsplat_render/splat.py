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
from gsstream_gsplat_render.tiles import TILE, Grid, RowKernels, tile_lists

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
    order, offsets = _sorted(kernels, seen.means2d[None], seen.radii[None], depths=seen.depths[None], views=view)
    wanted = None if mask is None else mask[: len(offsets[0])]
    image, alpha = _rasterized(kernels, seen, view, offsets=offsets.squeeze(0), order=order, mask=wanted)
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
        order, offsets = _sorted(kernels, means2d, radii, depths=depths, views=views)
        image, alpha = kernels.rasterize(
            means2d,
            conics,
            colors,
            opacities.expand(len(colors), -1),
            views.width,
            views.height,
            TILE,
            offsets,
            order,
            backgrounds=views.background,
            masks=None,
            packed=False,
        )
        begins = [*offsets[:, 0, 0].cpu().tolist(), len(order)]
    longest = max(end - begin for begin, end in pairwise(begins))
    return Pictures(image, alpha.squeeze(-1), boxes.view(*radii.shape[:2], 4), longest)


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
        order, offsets = _sorted(kernels, means2d, radii, depths=depths, views=views)
    brightness = means2d.new_ones(*radii.shape[:2], 1).requires_grad_()
    with torch.enable_grad():
        image, _ = kernels.rasterize(
            means2d,
            conics,
            brightness,
            opacities.expand(len(means2d), -1),
            views.width,
            views.height,
            TILE,
            offsets,
            order,
            backgrounds=torch.zeros_like(views.background[:, :1]),
            masks=tiles,
            packed=False,
        )
        (weights,) = torch.autograd.grad(image, brightness, torch.ones_like(image))
    return (weights > 0).flatten(2).any(2).any(0)


def _sorted(
    kernels: Kernels, means2d: torch.Tensor, radii: torch.Tensor, depths: torch.Tensor, views: Target
) -> tuple[torch.Tensor, torch.Tensor]:
    """Entries of the tiles of V views, and [V, rows, columns] where those of each tile begin."""
    (rows, columns), count = views.tiles, len(means2d)
    _, keys, order = kernels.tiles(means2d, radii, depths, TILE, columns, rows, packed=False, n_images=count)
    return order, kernels.offsets(keys, count, columns, rows).reshape(count, rows, columns)


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


class Placed(torch.autograd.Function):
    """The six tables of a scene with other rows ``index`` [A], which are put into the very tables.

    Only the rows have a gradient. It is that of one use of the tables: the next puts other rows into them.
    """

    @staticmethod
    def forward(
        ctx: Any, kernels: RowKernels, index: torch.Tensor, whole: tuple[torch.Tensor, ...], *rows: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        kernels.put(index, *rows, *whole)
        ctx.set_materialize_grads(False)
        ctx.kernels, ctx.index, ctx.whole = kernels, index, whole
        return tuple(table.view_as(table) for table in whole)

    @staticmethod
    def backward(ctx: Any, *upstream: Any) -> Any:
        # Of a table that has no gradient anything may be taken: nobody looks at it.
        given = [table if grad is None else grad for grad, table in zip(upstream, ctx.whole, strict=True)]
        taken = ctx.kernels.take(ctx.index, *given)
        return None, None, None, *(None if grad is None else rows for grad, rows in zip(upstream, taken, strict=True))


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


def _empty(view: Target) -> Drawn:
    image = view.background.expand(view.height * view.width, 3).reshape(view.height, view.width, 3).clone()
    return Drawn(image, torch.zeros_like(image[..., 0]), 0)
