"""gsplat's five functions in plain torch on the CPU, as its documentation describes them.

What the library leaves undefined is NaN here: rows that are not visible, and the alpha of masked tiles.
"""

from __future__ import annotations

from typing import Any

import torch
from gsstream_gsplat_render.kernels import Kernels

from gsstream.api import Cameras, Gaussians
from gsstream.parts.render.reference import evaluate_sh, footprint_in_image
from gsstream.parts.render.reference import project as reference_project

NAN = float("nan")


def project(
    means: torch.Tensor, covars: None, quats: torch.Tensor, scales: torch.Tensor, viewmats: torch.Tensor,
    Ks: torch.Tensor, width: int, height: int, *, eps2d: float, near_plane: float, far_plane: float,
    radius_clip: float, packed: bool, calc_compensations: bool, opacities: torch.Tensor,
) -> tuple[Any, ...]:  # fmt: skip
    assert covars is None
    assert (eps2d, radius_clip, packed, calc_compensations) == (0.3, 0.0, False, False)
    n = len(means)
    assert (viewmats.shape, Ks.shape, opacities.shape) == ((1, 4, 4), (1, 3, 3), (n,))
    cameras = Cameras(("c",), viewmats.double().numpy(), Ks.double().numpy(), width, height, near_plane)
    sh = torch.zeros(n, 1, 3)
    raw = Gaussians(means, quats, scales.log(), opacities.logit(), sh, sh[:, :0])
    means2d, conics, _, depths, _ = reference_project(raw, cameras, 0)
    seen = footprint_in_image(raw.map(torch.Tensor.detach), cameras, 0) & (depths.detach() <= far_plane)
    triangle = torch.stack([conics[:, 0, 0], conics[:, 0, 1], conics[:, 1, 1]], -1)
    radii = torch.where(seen, 8, 0).to(torch.int32)[:, None].expand(n, 2)
    out = [torch.where(seen[:, None], means2d, NAN), torch.where(seen, depths, NAN)]
    return radii[None], out[0][None], out[1][None], torch.where(seen[:, None], triangle, NAN)[None], None


def harmonics(
    degree: int, directions: torch.Tensor, coefficients: torch.Tensor, masks: torch.Tensor | None = None
) -> torch.Tensor:
    assert directions.shape == (*coefficients.shape[:2], 3)
    assert (degree + 1) ** 2 == coefficients.shape[-2]
    # evaluate_sh adds 0.5 and cuts at 0, gsplat does neither: an offset keeps it clear of the cut and is taken off.
    lifted = coefficients[0, :, :1] + 1000
    colors = evaluate_sh(lifted.double(), coefficients[0, :, 1:].double(), directions[0].double())
    colors = (colors - 0.5 - 1000 * 0.28209479177387814).float()[None]
    return colors if masks is None else torch.where(masks[..., None], colors, NAN)


def tiles(
    means2d: torch.Tensor, radii: torch.Tensor, depths: torch.Tensor, tile_size: int, columns: int, rows: int, *,
    packed: bool, n_images: int,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:  # fmt: skip
    assert (packed, n_images, tile_size) == (False, 1, 16)
    seen = (radii[0] > 0).all(-1).nonzero()[:, 0]
    order = seen[torch.argsort(depths[0].detach()[seen], stable=True)]
    return (radii[0, :, 0] > 0).int()[None], torch.arange(len(order)), order.int()


def offsets(keys: torch.Tensor, n_images: int, columns: int, rows: int) -> torch.Tensor:
    return torch.zeros(n_images, rows, columns, dtype=torch.int32)


def rasterize(
    means2d: torch.Tensor, conics: torch.Tensor, colors: torch.Tensor, opacities: torch.Tensor, width: int,
    height: int, tile_size: int, starts: torch.Tensor, order: torch.Tensor, *, backgrounds: torch.Tensor,
    masks: torch.Tensor | None, packed: bool,
) -> tuple[torch.Tensor, torch.Tensor]:  # fmt: skip
    rows = order.long()
    n = means2d.shape[1]
    assert (conics.shape, colors.shape, opacities.shape) == ((1, n, 3), (1, n, 3), (1, n))
    assert backgrounds.shape == (1, 3)
    ys, xs = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    dx = xs - means2d[0, rows, 0, None, None]
    dy = ys - means2d[0, rows, 1, None, None]
    a, b, c = (conics[0, rows, k, None, None] for k in range(3))
    falloff = torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    alpha = (opacities[0, rows, None, None] * falloff).clamp_max(0.999)
    alpha = torch.where(alpha >= 1 / 255, alpha, torch.zeros_like(alpha))
    # The Gaussian that would take the transmittance to 1e-4 or below ends the pixel and is not drawn itself.
    alpha = torch.where(torch.cumprod(1 - alpha.detach(), 0) > 1e-4, alpha, torch.zeros_like(alpha))
    after = torch.cumprod(torch.cat([torch.ones(1, height, width), 1 - alpha]), 0)
    image = torch.einsum("nhw,nc->hwc", alpha * after[:-1], colors[0, rows]) + after[-1][..., None] * backgrounds[0]
    opaque = 1 - after[-1]
    if masks is not None:
        assert masks.shape == starts.shape
        inside = masks[0].repeat_interleave(16, 0).repeat_interleave(16, 1)[:height, :width]
        image = torch.where(inside[..., None], image, backgrounds[0])
        opaque = torch.where(inside, opaque, NAN)
    return image[None], opaque[None, ..., None]


TORCH_KERNELS = Kernels(project, harmonics, tiles, offsets, rasterize)
