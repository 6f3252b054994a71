"""Which Gaussians the training images would not miss: the squared error that each one's absence adds to them.

Growth follows gradients, which says where Gaussians are wanted, never which ones have become superfluous. A pixel is
linear in the opacity of one Gaussian, so what its absence changes there is known from the gradient. (Speedy-Splat,
Hanson et al. 2025, ranks by a like score and drops a fixed share; the exact change, and the bound by what an image is
off by anyway, which leaves the number to the scene, are ours.) Opacity or blending weight are no such measure: a
Gaussian may fill many pixels with what is behind it anyway.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from gsstream.core.gaussians import Gaussians
from gsstream.engine.fit.photometric import render_exposed
from gsstream.engine.frame0.hutchinson import TrainingViews, hutchinson_samples

#: Probes of a camera. A Gaussian that one camera sees is underestimated tenfold by a quarter of single probes, and by
#: four together in one case of sixty.
HUTCHINSON_SAMPLES = 4
#: Opacity logits are clamped to this (opacity 0.999): where an opacity is 1 in float32 the gradient is 0.
MAX_LOGIT = 7.0
#: Factor by which the error of the images may grow when all pruned Gaussians are left out; the fit that follows closes
#: such gaps.
GROWTH = 1.25
#: How often fewer Gaussians are tried instead, each time those that together add a quarter of the error.
TRIES = 8


def removal_errors(
    views: TrainingViews, gaussians: Gaussians[torch.Tensor], generator: torch.Generator, *, probes: int
) -> tuple[torch.Tensor, float]:
    """Return the squared change of the images if each Gaussian alone is removed, and their error with all of them.

    Returns [N] float64, the squared change of all channels of all pixels together, and the mean squared error of a
    channel of a pixel.

    Arguments:
        views: training images.
        gaussians: [N] raw values.
        generator: random generator of the signs.
        probes: images of random signs for each camera, at least 1; the estimate is their mean.
    """
    rows = replace(gaussians, opacities=gaussians.opacities.clamp(max=MAX_LOGIT))
    squares = torch.zeros_like(rows.opacities, dtype=torch.float64)
    error = 0.0
    for probe in hutchinson_samples(views, rows, generator, each=probes):
        squares += probe.grad.opacities.double().square()
        error += probe.error
    # By the opacity o instead of its logit, times o, which is how far it falls: o / (o (1 - o)).
    left = 1 - rows.opacities.double().sigmoid()
    return squares / probes / left**2, error / (probes * len(views.frame.cameras))


def retained_rows(errors: torch.Tensor, least: float) -> torch.Tensor:
    """Return the rows [K] int64, in order, of the Gaussians whose absence adds more than ``least``.

    Where no absence adds more than ``least``, all rows remain.
    """
    rows = (errors > least).nonzero()[:, 0]
    return rows if len(rows) else torch.arange(len(errors), device=errors.device)


def prune_by_error(
    views: TrainingViews, gaussians: Gaussians[torch.Tensor], generator: torch.Generator, least: float
) -> torch.Tensor:
    """Return the rows [K] int64, in order, that remain when those go that the training images would not miss.

    Gaussians that are dispensable one by one may not be so together: of ten equal ones none is missed. So where the
    error of the images without all of them is more than ``GROWTH`` times as large, only Gaussians of a smaller error
    are removed.
    """
    errors, error = removal_errors(views, gaussians, generator, probes=HUTCHINSON_SAMPLES)
    for _ in range(TRIES):
        rows = retained_rows(errors, least * error)
        if len(rows) == len(errors):
            return rows
        if _mean_error(views, gaussians.rows(rows)) <= GROWTH * error:
            return rows
        least /= 4
    return torch.arange(len(errors), device=errors.device)


def _mean_error(views: TrainingViews, gaussians: Gaussians[torch.Tensor]) -> float:
    cameras, error = views.frame.cameras, 0.0
    for view in range(len(cameras)):
        seen = render_exposed(
            views.renderer, gaussians, cameras, view=view, background=views.background, exposure=views.exposure
        )
        error += views.error(view, seen)
    return error / len(cameras)
