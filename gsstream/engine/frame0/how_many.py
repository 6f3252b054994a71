"""How many Gaussians frame 0 may have: what its images can pin down, and of those the ones that its images show.

A fit with more parameters than its images have evidence for describes the training cameras, not the scene: cameras that
are left out see it get worse while training cameras see it get better. And growth follows gradients, which says where
Gaussians are wanted, never which ones have become superfluous (docs/results/frame0.md). The share of the blending
weight by which the superfluous ones are found is also what LightGaussian (Fan et al. 2023) and Mini-Splatting (Fang and
Wang 2024) rank by; taking the largest of all views and the rule for how many are ours.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from gsstream.core.cameras import Cameras
from gsstream.core.frame import Frame
from gsstream.core.gaussians import SH0, Gaussians
from gsstream.engine.fit.backward import pull_back
from gsstream.recipe.model import FirstFrame
from gsstream.render.base import Renderer


def most_gaussians(settings: FirstFrame, frame: Frame) -> int:
    """Return the number of Gaussians that growth may reach: the cap, or fewer where there are few pixels.

    Arguments:
        settings: section ``first_frame`` of the recipe.
        frame: training images of frame 0.
    """
    if settings.pixels_per_gaussian == 0:
        return settings.max_gaussians
    pixels = frame.images[..., 0].size
    return min(settings.max_gaussians, max(1, int(pixels / settings.pixels_per_gaussian)))


def shown(renderer: Renderer, gaussians: Gaussians[torch.Tensor], cameras: Cameras) -> torch.Tensor:
    """Return [N] float32: the pixels of one view that each Gaussian fills, in the view that shows most of it.

    A pixel counts with the weight that the Gaussian has in its colour: opacity times what is left of the light.

    Arguments:
        renderer: of the run.
        gaussians: N rows, raw values, without gradients.
        cameras: the rig.
    """
    most = torch.zeros(len(gaussians))
    for view in range(len(cameras)):
        # An image is linear in colours, and the slope is the weight. Grey is far from where colours are cut off.
        grey = torch.zeros_like(gaussians.sh0, requires_grad=True)
        rows = replace(gaussians, sh0=grey, shN=gaussians.shN[:, :0])
        image = renderer.render(rows, cameras, view, (0.0, 0.0, 0.0)).image
        pull_back((image,), (torch.ones_like(image),))
        if grey.grad is not None:
            most = torch.maximum(most, grey.grad.reshape(len(gaussians), -1).mean(1))
    return most / SH0


def worth_keeping(shown_pixels: torch.Tensor, share: float) -> torch.Tensor:
    """Return the rows [K] int64, in order, of the Gaussians that remain when the least shown ones go.

    Those go, beginning with the least, whose pixels together are at most ``share`` of the pixels of all. Where no view
    shows anything, all remain.

    Arguments:
        shown_pixels: [N] as :func:`shown` gives it.
        share: 0 to 1.
    """
    order = torch.argsort(shown_pixels, stable=True)
    lost = torch.cumsum(shown_pixels[order].double(), 0)
    if len(order) == 0 or lost[-1] == 0:
        return torch.arange(len(order))
    return order[int((lost <= share * lost[-1]).sum()) :].sort().values
