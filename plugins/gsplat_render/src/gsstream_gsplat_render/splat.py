"""One view drawn by gsplat's functions, from raw parameters to image and alpha; differentiable."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch

from gsstream.api import Gaussians
from gsstream_gsplat_render.kernels import Kernels
from gsstream_gsplat_render.rig import TILE, Target

BLUR = 0.3  # px^2, added to the 2-D covariance: what gsplat calls eps2d
FAR = 1e10


@dataclass(frozen=True, slots=True)
class Projected:
    """Gaussians as one camera sees them, on the device."""

    visible: torch.Tensor  # [N] bool, it touches the image; of all others gsplat leaves the rest undefined
    means2d: torch.Tensor  # [N, 2] pixels
    depths: torch.Tensor  # [N]
    conics: torch.Tensor  # [N, 3]
    colors: torch.Tensor  # [N, 3]
    opacities: torch.Tensor  # [N]
    radii: torch.Tensor  # [N, 2] int32, half the sides of the box in which it is drawn, pixels

    def rows(self, index: torch.Tensor) -> Projected:
        """Return some of them."""
        return Projected(*(getattr(self, field.name)[index] for field in fields(self)))


@dataclass(frozen=True, slots=True)
class Drawn:
    """Image [H, W, 3] and alpha [H, W] on the device; differentiable."""

    image: torch.Tensor
    alpha: torch.Tensor


def project(
    kernels: Kernels, gaussians: Gaussians[torch.Tensor], view: Target, probe: torch.Tensor | None = None
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
    visible = (radii > 0).all(-1)
    if probe is not None:
        means2d = means2d + probe[None]
    colors = _colors(kernels, gaussians, view, visible)
    # Squeezed and not indexed: the gradient of a view is a view, that of an index is a copy.
    return Projected(
        visible=visible.squeeze(0),
        means2d=means2d.squeeze(0),
        depths=depths.squeeze(0),
        conics=conics.squeeze(0),
        colors=colors.squeeze(0),
        opacities=opacities,
        radii=radii.squeeze(0),
    )


def composite(kernels: Kernels, seen: Projected, view: Target, mask: torch.Tensor | None = None) -> Drawn:
    """Composite what was projected; with a mask [tile rows, tile columns] in its tiles, else show the background."""
    rows, columns = view.tiles
    means2d, radii = seen.means2d[None], seen.radii[None]
    _, keys, order = kernels.tiles(means2d, radii, seen.depths[None], TILE, columns, rows, packed=False, n_images=1)
    offsets = kernels.offsets(keys, 1, columns, rows).reshape(1, rows, columns)
    image, alpha = kernels.rasterize(
        means2d,
        seen.conics[None],
        seen.colors[None],
        seen.opacities[None],
        view.width,
        view.height,
        TILE,
        offsets,
        order,
        backgrounds=view.background,
        masks=None if mask is None else mask[None],
        packed=False,
    )
    image, alpha = image.squeeze(0), alpha.squeeze((0, 3))
    if mask is not None:
        # gsplat 1.5 writes the background into masked tiles but leaves their alpha as the memory was.
        alpha = torch.where(pixels(mask, view), alpha, torch.zeros_like(alpha))
    return Drawn(image, alpha)


def draw(
    kernels: Kernels,
    gaussians: Gaussians[torch.Tensor],
    view: Target,
    probe: torch.Tensor | None = None,
    mask: torch.Tensor | None = None,
) -> Drawn:
    """Draw raw Gaussians [N] that are on the device already."""
    if len(gaussians) == 0:
        return _empty(view)
    return composite(kernels, project(kernels, gaussians, view, probe), view, mask)


def touched_tiles(seen: Projected, view: Target) -> torch.Tensor:
    """Return [tile rows, tile columns] bool: the tiles in which gsplat draws any of the projected Gaussians.

    Corners of every box are added into a table, whose running sums then count the boxes over each tile: nothing has a
    size that depends on values, so the processor does not wait.
    """
    down, across = view.tiles
    centre = torch.where(seen.visible[:, None], seen.means2d.detach(), 0.0) / TILE
    half = torch.where(seen.visible[:, None], seen.radii, 0) / TILE
    # As gsplat's isect_tiles: from the tile of the lower corner to before that beyond the upper one.
    low = (centre - half).floor().clamp_min(0).minimum(view.corner).long()
    high = (centre + half).ceil().clamp_min(0).minimum(view.corner).long()
    marks = torch.zeros((down + 1) * (across + 1), dtype=torch.int32, device=centre.device)
    visible = seen.visible.int()
    for x, y, sign in ((low, low, 1), (high, low, -1), (low, high, -1), (high, high, 1)):
        marks.index_add_(0, y[:, 1] * (across + 1) + x[:, 0], sign * visible)
    return marks.reshape(down + 1, across + 1).cumsum(0).cumsum(1)[:down, :across] > 0


def pixels(mask: torch.Tensor, view: Target) -> torch.Tensor:
    """A tile mask [rows, columns] as a pixel mask [H, W]."""
    wide = mask.repeat_interleave(TILE, 0).repeat_interleave(TILE, 1)
    return wide[: view.height, : view.width]


def _colors(kernels: Kernels, gaussians: Gaussians[torch.Tensor], view: Target, visible: torch.Tensor) -> torch.Tensor:
    """[1, N, 3] colours max(0, 0.5 + harmonics), seen from the camera."""
    viewmat = view.viewmat[0]
    center = -(viewmat[:3, :3].T @ viewmat[:3, 3])
    coefficients = torch.cat([gaussians.sh0, gaussians.shN], 1)
    directions = gaussians.means - center
    harmonics = kernels.harmonics(gaussians.sh_degree, directions[None], coefficients[None], masks=visible)
    return torch.clamp_min(harmonics + 0.5, 0.0)


def _empty(view: Target) -> Drawn:
    image = view.background.expand(view.height * view.width, 3).reshape(view.height, view.width, 3).clone()
    return Drawn(image, torch.zeros_like(image[..., 0]))
