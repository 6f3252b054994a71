"""Scenes for the tests of S2GS, made with the kit's worlds, and contexts whose screen gradients are dictated."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import torch

from gsstream.api import Cameras, Gaussians
from gsstream.testing import World, images, make_case, rig, scene
from tests.scenes import Dictated

__all__ = ["SIZE", "context", "gaussians", "images", "moving", "rig", "told"]
Images = Sequence[torch.Tensor]
SIZE = rig().width


def gaussians(n: int = 60, seed: int = 0) -> Gaussians[torch.Tensor]:
    """Small, fairly opaque blobs in a ball of radius about 0.7; the last fifth lies outside every camera's view."""
    means = torch.randn(n, 3, generator=torch.Generator().manual_seed(seed)) * 0.35
    means[n - n // 5 :, 1] += 30.0
    return scene(means, seed)


def context(blobs: Gaussians[torch.Tensor], cameras: Cameras, before: Images, now: Images, sigma: float = 0.0) -> World:
    """What an estimator sees between two sets of images."""
    still = make_case("given images", blobs, cameras.select([]))
    return dataclasses.replace(still, cameras=cameras, before=tuple(before), now=tuple(now), sigma=sigma)


def told(gradient: torch.Tensor, visible: torch.Tensor | None = None) -> Dictated:
    """Dictate gradients [V, N, 2]."""
    views, n = gradient.shape[:2]
    blank = [torch.zeros(SIZE, SIZE, 3)] * views
    return Dictated.of(context(gaussians(n), rig(views), blank, blank), gradient, visible)


@functools.cache
def moving(shift: float = 0.08, strength: float = 1.0) -> tuple[World, torch.Tensor]:
    """One ball of 60 Gaussians of which those with x > 0.15 shift; the truth [N] bool (only those in view)."""
    blobs, cameras = gaussians(), rig()
    moved = (blobs.means[:, 0] > 0.15) & (blobs.means[:, 1] < 5)
    means = blobs.means.clone()
    means[moved, 1] += shift
    before, after = images(blobs, cameras), images(dataclasses.replace(blobs, means=means), cameras)
    return context(blobs, cameras, before, after).blended(strength), moved
