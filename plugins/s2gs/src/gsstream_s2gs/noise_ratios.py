"""Gradients of change and of error by Gaussians, in units of what each camera's noise alone would do."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch

from gsstream.api import FrameContext, Rng, check_finite


class NoiseRatios(NamedTuple):
    """Ratios to the noise, [N] float64: about 1 under noise alone, 0 without a gradient, or where no camera sees.

    ``error_ratio`` is that of what the render still lacks in both frames; zeros unless asked for.
    """

    change_ratio: torch.Tensor
    error_ratio: torch.Tensor


def noise_ratios(context: FrameContext, min_sigma: float, probes: int, seed: int, *, error: bool) -> NoiseRatios:
    """Both ratios over all views: one backward pass per view for each, and one per probe.

    Raises ShapeError when an image's gradient is not finite.
    """
    means = context.gaussians.means
    change = torch.zeros(len(means), dtype=torch.float64, device=means.device)
    lacking, noise = change.clone(), change.clone()
    for view in range(len(context.cameras)):
        now, before = context.image(view), context.previous_image(view)
        sigma = max(context.noise_sigma(view), min_sigma)
        # Unit noise in either case: a difference holds the noise of two images, a mean half the variance of one.
        change += _energy(context, view, (before - now) / (math.sqrt(2) * sigma))
        if error:
            residue = context.previous_render(view) - (before + now) / 2
            lacking += _energy(context, view, residue * (math.sqrt(2) / sigma))
        for probe in range(probes):
            # By the camera's name, so that the order of the cameras does not matter.
            generator = Rng(seed).stream(f"s2gs/whitened/{context.cameras.ids[view]}/{probe}", context.index)
            draw = torch.randn(now.shape, generator=generator, dtype=now.dtype)
            noise += _energy(context, view, draw.to(now.device)) / probes
    return NoiseRatios(_ratio(change, noise), _ratio(lacking, noise))


def _energy(context: FrameContext, view: int, upstream: torch.Tensor) -> torch.Tensor:
    """[N] squared length of the screen gradient; double precision, since float32 squares vanish below 1e-23."""
    gradient, visible = context.screen_gradient(view, upstream)
    check_finite(f"screen gradient of view {view} at frame {context.index}", gradient)
    return gradient.double().square().sum(1) * visible


def _ratio(energy: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
    reached = noise > 0
    return (energy / noise.where(reached, torch.ones_like(noise))).sqrt() * reached
