"""One view drawn by gsplat's functions, from raw parameters to image and alpha; differentiable."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from gsstream.api import Cameras, Gaussians
from gsstream_gsplat_render.kernels import Kernels

TILE = 16
BLUR = 0.3  # px^2, added to the 2-D covariance: what gsplat calls eps2d
FAR = 1e10

Background = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Target:
    """A camera and its background on the device: viewmat [1, 4, 4], K [1, 3, 3], background [1, 3], all float32."""

    viewmat: torch.Tensor
    K: torch.Tensor
    background: torch.Tensor
    width: int
    height: int
    near: float

    @property
    def tiles(self) -> tuple[int, int]:
        """Tile rows and columns; partial tiles count."""
        return -(-self.height // TILE), -(-self.width // TILE)


@dataclass(frozen=True, slots=True)
class Drawn:
    """Image [H, W, 3], alpha [H, W] and which Gaussians touch the image [N] bool, on the device."""

    image: torch.Tensor
    alpha: torch.Tensor
    visible: torch.Tensor


def target(cameras: Cameras, view: int, background: Background, device: str) -> Target:
    """Camera ``view`` of a rig, moved to the device."""

    def moved(value: object) -> torch.Tensor:
        return torch.as_tensor(value, dtype=torch.float32).to(device)[None]

    return Target(
        moved(cameras.viewmats[view]), moved(cameras.Ks[view]), moved(background), cameras.width, cameras.height,
        cameras.near_plane,
    )  # fmt: skip


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
    opacities = gaussians.opacities.sigmoid()
    radii, means2d, depths, conics, _ = kernels.project(
        gaussians.means, None, gaussians.quats, gaussians.scales.exp(), view.viewmat, view.K, view.width, view.height,
        eps2d=BLUR, near_plane=view.near, far_plane=FAR, radius_clip=0.0, packed=False, calc_compensations=False,
        opacities=opacities,
    )  # fmt: skip
    visible = (radii > 0).all(-1)  # [1, N]; of other rows gsplat leaves everything undefined
    if probe is not None:
        means2d = means2d + probe[None]
    colors = _colors(kernels, gaussians, view, visible)
    rows, columns = view.tiles
    _, keys, order = kernels.tiles(means2d, radii, depths, TILE, columns, rows, packed=False, n_images=1)
    offsets = kernels.offsets(keys, 1, columns, rows).reshape(1, rows, columns)
    image, alpha = kernels.rasterize(
        means2d, conics, colors, opacities[None], view.width, view.height, TILE, offsets, order,
        backgrounds=view.background, masks=None if mask is None else mask[None], packed=False,
    )  # fmt: skip
    image, alpha = image[0], alpha[0, ..., 0]
    if mask is not None:
        # gsplat 1.5 writes the background into masked tiles but leaves their alpha as the memory was.
        alpha = torch.where(pixels(mask, view), alpha, torch.zeros_like(alpha))
    return Drawn(image, alpha, visible[0])


def pixels(mask: torch.Tensor, view: Target) -> torch.Tensor:
    """A tile mask [rows, columns] as a pixel mask [H, W]."""
    wide = mask.repeat_interleave(TILE, 0).repeat_interleave(TILE, 1)
    return wide[: view.height, : view.width]


def _colors(
    kernels: Kernels, gaussians: Gaussians[torch.Tensor], view: Target, visible: torch.Tensor
) -> torch.Tensor:
    """[1, N, 3] colours max(0, 0.5 + harmonics), seen from the camera."""
    viewmat = view.viewmat[0]
    center = -(viewmat[:3, :3].T @ viewmat[:3, 3])
    coefficients = torch.cat([gaussians.sh0, gaussians.shN], 1)
    directions = gaussians.means - center
    harmonics = kernels.harmonics(gaussians.sh_degree, directions[None], coefficients[None], masks=visible)
    return torch.clamp_min(harmonics + 0.5, 0.0)


def _empty(view: Target) -> Drawn:
    device = view.viewmat.device
    image = view.background.expand(view.height * view.width, 3).reshape(view.height, view.width, 3).clone()
    alpha = torch.zeros(view.height, view.width, device=device)
    return Drawn(image, alpha, torch.zeros(0, dtype=torch.bool, device=device))
