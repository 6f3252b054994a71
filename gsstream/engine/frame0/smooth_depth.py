"""Depth that changes only where the picture does: what keeps shards from standing across a wall."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch.nn.functional import adaptive_avg_pool2d

from gsstream.core.frame import Frame
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray
from gsstream.parts.render.activations import rgb_to_sh0
from gsstream.parts.render.backward import backward, gradient_of
from gsstream.parts.render.base import Renderer

#: Difference of two pixels, in [0, 1], over which a change of depth becomes e times cheaper.
EDGE = 0.1
#: What is differentiated; colours have no part in depth.
PLACED = ("means", "quats", "scales", "opacities")
#: Extents of the rig at which inverse depth is 1, at which it ends, and the least depth that is told apart.
UNIT, MOST, NEAREST = 0.3, 3.0, 0.02
#: Least share of a pixel's light that a depth is divided by.
LEAST_ALPHA = 0.1


def add_smooth_depth_grad(
    renderer: Renderer, rows: Gaussians[torch.Tensor], frame: Frame, view: int, grad: Gaussians[torch.Tensor],
    weight: float,
) -> None:  # fmt: skip
    """Add to ``grad`` that of ``weight`` times the change of inverse depth where a view's image has no edge.

    Depth is drawn at half size, which is all that smoothness needs. ``grad`` is changed in place.
    """
    leaves = rows.map(lambda value: value.detach().clone().requires_grad_())
    loss = mean_roughness(renderer, leaves, frame, view)
    if not loss.requires_grad:  # nothing is drawn
        return
    backward([loss], [torch.full_like(loss, weight)])
    for name in PLACED:
        getattr(grad, name).add_(gradient_of(getattr(leaves, name)))


def mean_roughness(renderer: Renderer, leaves: Gaussians[torch.Tensor], frame: Frame, view: int) -> torch.Tensor:
    """Return [] mean change of inverse depth from pixel to pixel along both axes, less where the image changes."""
    cameras = frame.cameras
    half = cameras.scaled(max(1, cameras.width // 2), max(1, cameras.height // 2))
    pose = torch.from_numpy(half.viewmats[view]).to(leaves.means)
    depth = leaves.means @ pose[2, :3] + pose[2, 3]
    inverse = (UNIT * cameras.extent / depth.clamp_min(NEAREST * cameras.extent)).clamp(max=MOST)
    # Inverse depth is drawn as a colour on black, so that what a pixel shows is its mean times alpha.
    shown = replace(leaves, sh0=rgb_to_sh0(inverse[:, None].repeat(1, 3)), shN=torch.zeros_like(leaves.shN))
    drawn = renderer.render(shown, half, view, (0.0, 0.0, 0.0))
    blended = drawn.image[..., 0] / drawn.alpha.clamp_min(LEAST_ALPHA)
    image = _halved(frame.images[view], half.height, half.width).to(blended.device)
    terms = []
    for axis in (0, 1):
        if blended.shape[axis] > 1:
            edges = image.diff(dim=axis + 1).abs().mean(0)
            terms.append((blended.diff(dim=axis).abs() * torch.exp(-edges / EDGE)).mean())
    return torch.stack(terms).sum() if terms else blended.new_zeros(())


def _halved(image: FloatArray, height: int, width: int) -> torch.Tensor:
    """[3, height, width] of an image [H, W, 3]."""
    return adaptive_avg_pool2d(torch.from_numpy(image).permute(2, 0, 1), (height, width))
