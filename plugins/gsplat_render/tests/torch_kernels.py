"""The functions of a GPU on the processor: gsplat's five, and the three in Triton.

gsplat 1.5.3 has torch formulas of four of its own (``gsplat.cuda._torch_impl``); that of the fifth needs CUDA, and a
rasteriser of ours that reads its tiles stands in its place. What the
kernels leave undefined is NaN here: rows that are not visible, and the alpha of masked tiles.
"""

from __future__ import annotations

from typing import Any

import torch
from gsplat.cuda import _torch_impl as gsplat
from gsstream_gsplat_render.fused import Fused
from gsstream_gsplat_render.kernels import Kernels
from gsstream_gsplat_render.placed import ROWS_IN_TORCH
from gsstream_gsplat_render.tiles import IN_TORCH

from gsstream.core.hierarchy import Hierarchy
from gsstream.parts.backend.adam import ReferenceAdam
from gsstream.parts.gate.base import AnalyticGate
from gsstream.parts.regularizer.base import AnalyticPenalty
from gsstream.parts.render.loss import ReferenceLoss, _windowed, ssim_and_grads
from gsstream.parts.residual.adam_state import MAX_GRADIENT, AdamState
from gsstream.parts.residual.rate import MIN_SPREAD, laplace_gradient

NAN = float("nan")


def project(
    means: torch.Tensor,
    covars: None,
    quats: torch.Tensor,
    scales: torch.Tensor,
    viewmats: torch.Tensor,
    Ks: torch.Tensor,
    width: int,
    height: int,
    *,
    eps2d: float,
    near_plane: float,
    far_plane: float,
    radius_clip: float,
    packed: bool,
    calc_compensations: bool,
    opacities: torch.Tensor,
) -> tuple[Any, ...]:
    assert (covars, packed, calc_compensations, radius_clip) == (None, False, False, 0.0)
    whole, _ = gsplat._quat_scale_to_covar_preci(quats, scales, True, False, triu=False)
    radii, means2d, depths, conics, _ = gsplat._fully_fused_projection(
        means, whole, viewmats, Ks, width, height, eps2d, near_plane, far_plane
    )
    # The kernel's box reaches as far as the opacity does, in whole pixels (ProjectionEWA3DGSFused.cu).
    a, b, c = conics.detach().unbind(-1)
    det, reach = a * c - b * b, (2 * (opacities.detach() * 255).clamp_min(1).log()).sqrt().clamp_max(3.33)
    box = torch.stack([(reach * (c / det).sqrt()).ceil(), (reach * (a / det).sqrt()).ceil()], -1)
    size = box.new_tensor([width, height])
    inside = ((means2d.detach() + box > 0) & (means2d.detach() - box < size)).all(-1, keepdim=True)
    seen = (radii > 0) & inside & (box > 0) & (opacities.detach() >= 1 / 255)[None, :, None]
    radii, seen = torch.where(seen, box.int(), torch.zeros_like(radii)), seen.all(-1)
    wide = seen[..., None]
    means2d, depths, conics = (
        torch.where(mask, value, NAN) for mask, value in ((wide, means2d), (seen, depths), (wide, conics))
    )
    return radii * wide, means2d, depths, conics, None


def harmonics(
    degree: int, directions: torch.Tensor, coefficients: torch.Tensor, masks: torch.Tensor | None = None
) -> torch.Tensor:
    colors: torch.Tensor = gsplat._spherical_harmonics(degree, directions, coefficients)
    return colors if masks is None else torch.where(masks[..., None], colors, NAN)


def tiles(
    means2d: torch.Tensor,
    radii: torch.Tensor,
    depths: torch.Tensor,
    tile_size: int,
    columns: int,
    rows: int,
    *,
    packed: bool,
    n_images: int,
) -> tuple[torch.Tensor, ...]:
    assert (packed, n_images) == (False, len(means2d))
    seen, nothing = (radii > 0).all(-1), torch.zeros(())
    means2d, depths = means2d.detach().where(seen[..., None], nothing), depths.detach().where(seen, nothing)
    number, keys, order = gsplat._isect_tiles(means2d, radii, depths, tile_size, columns, rows, sort=False)
    # As the kernel does it: Gaussians of equal depth stay in their order.
    keys, place = keys.sort(stable=True)
    return number, keys, order[place]


def offsets(keys: torch.Tensor, n_images: int, columns: int, rows: int) -> torch.Tensor:
    found: torch.Tensor = gsplat._isect_offset_encode(keys, n_images, columns, rows)
    return found


def rasterize(
    means2d: torch.Tensor,
    conics: torch.Tensor,
    colors: torch.Tensor,
    opacities: torch.Tensor,
    width: int,
    height: int,
    tile_size: int,
    starts: torch.Tensor,
    order: torch.Tensor,
    *,
    backgrounds: torch.Tensor,
    masks: torch.Tensor | None,
    packed: bool,
) -> tuple[torch.Tensor, torch.Tensor]:
    assert not packed
    splats, ends = (means2d, conics, colors, opacities), [*starts[1:, 0, 0].tolist(), len(order)]
    views = [
        _view(
            *(value[view] for value in splats),
            size=(width, height, tile_size),
            starts=starts[view] - begin,
            order=order[begin:end] - view * means2d.shape[1],
            background=backgrounds[view],
            mask=None if masks is None else masks[view],
        )
        for view, (begin, end) in enumerate(zip(starts[:, 0, 0].tolist(), ends, strict=True))
    ]
    # As of the kernel, gradients are zero and not missing where nothing is drawn.
    nothing = sum(value[:, :0].sum() for value in splats)
    image, alpha = (torch.stack(each) for each in zip(*views, strict=True))
    return image + nothing, alpha[..., None] + nothing


def _view(
    means2d: torch.Tensor,
    conics: torch.Tensor,
    colors: torch.Tensor,
    opacities: torch.Tensor,
    *,
    size: tuple[int, int, int],
    starts: torch.Tensor,
    order: torch.Tensor,
    background: torch.Tensor,
    mask: torch.Tensor | None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """One picture [H, W, 3] and its alpha [H, W]."""
    width, height, tile_size = size
    # There may be more rows of tiles than the picture has: they hold what is left of lists of fixed size.
    rows, columns = -(-height // tile_size), starts.shape[-1]
    bounds = [*starts.flatten().tolist(), len(order)]
    image, alpha = [], []
    for row in range(rows):
        pictures, opaque = [], []
        for column in range(columns):
            place, tall = row * columns + column, min(tile_size, height - row * tile_size)
            wide = min(tile_size, width - column * tile_size)
            if mask is not None and not bool(mask.flatten()[place]):
                pictures.append(background.expand(tall, wide, len(background)))
                opaque.append(torch.full((tall, wide), NAN))  # left as the memory was
                continue
            ids = order[bounds[place] : bounds[place + 1]].long()
            splats = means2d[ids], conics[ids], colors[ids], opacities[ids]
            light, after = _tile(*splats, (column * tile_size, row * tile_size), (tall, wide))
            pictures.append(light + after[..., None] * background)
            opaque.append(1 - after)
        image.append(torch.cat(pictures, 1))
        alpha.append(torch.cat(opaque, 1))
    return torch.cat(image), torch.cat(alpha)


def _tile(
    means2d: torch.Tensor,
    conics: torch.Tensor,
    colors: torch.Tensor,
    opacities: torch.Tensor,
    corner: tuple[int, int],
    size: tuple[int, int],
) -> tuple[torch.Tensor, torch.Tensor]:
    """Light [h, w, 3] and transmittance [h, w] of one tile, front to back."""
    tall, wide = size
    dx = means2d[:, 0, None, None] - (torch.arange(wide) + corner[0] + 0.5)
    dy = means2d[:, 1, None, None] - (torch.arange(tall) + corner[1] + 0.5)[:, None]
    a, b, c = (conics[:, k, None, None] for k in range(3))
    power = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    alpha = (opacities[:, None, None] * torch.exp(-power)).clamp_max(0.999)
    alpha = torch.where((power >= 0) & (alpha >= 1 / 255), alpha, 0.0)
    # The Gaussian that would take the transmittance to 1e-4 or below ends the pixel and is not drawn itself.
    alpha = torch.where(torch.cumprod(1 - alpha.detach(), 0) > 1e-4, alpha, 0.0)
    after = torch.cumprod(torch.cat([torch.ones(1, tall, wide), 1 - alpha]), 0)
    return torch.einsum("nhw,nc->hwc", alpha * after[:-1], colors), after[-1]


TORCH_KERNELS = Kernels(project, harmonics, tiles, offsets, rasterize)


def loss_by_tile(
    image: torch.Tensor, target: torch.Tensor, dssim: float, tile_mask: torch.Tensor | None
) -> tuple[torch.Tensor, torch.Tensor]:
    planes, wanted = image.permute(2, 0, 1)[:, None], ReferenceLoss().prepare(target)
    similar, *grads = ssim_and_grads(planes, wanted)
    each = torch.lerp((planes - wanted.planes).abs(), 1 - similar, dssim).sum((0, 1))
    high, wide = -(-image.shape[0] // 16), -(-image.shape[1] // 16)
    sums = each.new_zeros(high * 16, wide * 16)
    sums[: image.shape[0], : image.shape[1]] = each
    sums = sums.reshape(high, 16, wide, 16).sum((1, 3))
    found = torch.stack([grad[:, 0] for grad in grads])
    if tile_mask is None:
        return sums, found
    near = torch.nn.functional.max_pool2d(tile_mask[None].float(), 3, 1, 1)[0].bool()
    # Elsewhere the kernel writes nothing.
    return torch.where(near, sums, 0.0), torch.where(pixels_of(near, image), found, NAN)


def gradient_by_pixel(
    image: torch.Tensor, target: torch.Tensor, by_window: torch.Tensor, dssim: float, tile_mask: torch.Tensor | None
) -> torch.Tensor:
    planes, wanted = image.permute(2, 0, 1), ReferenceLoss().prepare(target).planes[:, 0]
    known = by_window if tile_mask is None else by_window.nan_to_num(0.0)
    by_mean, by_square, by_product = (_windowed(grad[:, None])[:, 0] for grad in known)
    by_ssim = by_mean + 2 * planes * by_square + wanted * by_product
    gradient = ((1 - dssim) * (planes - wanted).sign() - dssim * by_ssim) / image.numel()
    if tile_mask is not None:
        gradient = torch.where(pixels_of(tile_mask, image), gradient, 0.0)
    return gradient.permute(1, 2, 0).contiguous()


def pixels_of(tiles: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
    """[H, W]: the marks of tiles of 16 x 16 pixels, pixel by pixel."""
    return tiles.repeat_interleave(16, 0).repeat_interleave(16, 1)[: image.shape[0], : image.shape[1]]


def move_table(
    value: torch.Tensor,
    gradient: torch.Tensor,
    exp_avg: torch.Tensor,
    exp_avg_sq: torch.Tensor,
    steps: torch.Tensor,
    corrections: torch.Tensor,
    lr: float | torch.Tensor,
    ahead: bool,
) -> torch.Tensor:
    state = AdamState(exp_avg, exp_avg_sq, steps, ahead)
    ReferenceAdam().move(value, gradient, state, corrections, lr=lr)
    return (gradient.abs() <= MAX_GRADIENT).all()


def sum_symbols(latents: torch.Tensor, steps: torch.Tensor) -> torch.Tensor:
    return torch.round(latents / steps).abs().sum(0, keepdim=True)


def add_rate(
    gradient: torch.Tensor,
    latents: torch.Tensor,
    steps: torch.Tensor,
    gates: torch.Tensor,
    sums: torch.Tensor,
    weight: float | torch.Tensor,
) -> None:
    spread = (sums.sum(0) / len(latents)).clamp_min(MIN_SPREAD)
    gradient.add_(laplace_gradient(latents, steps, spread, weight) * (gates > 0)[:, None])


def open_gates(
    logits: torch.Tensor, node_of: torch.Tensor, temperature: float, offset: float, levels: int
) -> tuple[torch.Tensor, torch.Tensor]:
    form = AnalyticGate(temperature, levels, 0.0, torch.inf, logit_offset=offset)
    opened, slopes = form.gates(logits)
    return opened[node_of], slopes[node_of]


def gate_gradients(
    by_gate: torch.Tensor,
    slopes: torch.Tensor,
    position: torch.Tensor,
    logits: torch.Tensor,
    node_of: torch.Tensor,
    open_logit: float,
    open_weight: float,
    displacement_weight: float,
) -> tuple[torch.Tensor, torch.Tensor]:
    probability, slope = AnalyticGate(1.0, 1, open_logit, torch.inf).probability(logits)
    rows = Hierarchy(node_of, torch.arange(len(logits)), torch.zeros(len(logits), dtype=torch.int64))
    by_probability, by_position = AnalyticPenalty(open_weight, displacement_weight, mean=False).grad(
        probability, position, rows, len(node_of)
    )
    by_images = torch.zeros_like(logits).index_add_(0, node_of, by_gate * slopes)
    return by_images + by_probability * slope, by_position


TORCH_FUSED = Fused(
    "cpu",
    loss_by_tile,
    gradient_by_pixel,
    move_table,
    sum_symbols,
    add_rate,
    open_gates,
    gate_gradients,
    rows=ROWS_IN_TORCH,
    tiles=IN_TORCH,
)
