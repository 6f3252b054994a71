"""A tiny world for the tests of S2GS: a rig, Gaussians, two frames, and the context an estimator is given."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import torch

from gsstream.api import Cameras, Gaussians, Hierarchy, ScreenGradient
from gsstream.render.reference import ReferenceRenderer

RENDERER = ReferenceRenderer()
BLACK = (0.0, 0.0, 0.0)
SIZE = 20


def rig(views: int = 3) -> Cameras:
    """Cameras on an arc of radius 3 around the origin, looking inwards."""
    viewmats = []
    for angle in np.linspace(-0.4, 0.4, views):
        c, s = np.cos(angle), np.sin(angle)
        viewmat = np.eye(4)
        viewmat[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
        viewmat[2, 3] = 3.0
        viewmats.append(viewmat)
    K = np.array([[25.0, 0, SIZE / 2], [0, 25.0, SIZE / 2], [0, 0, 1]])
    ids = tuple(f"cam{i}" for i in range(views))
    return Cameras(ids, np.array(viewmats).reshape(-1, 4, 4), np.tile(K, (views, 1, 1)), SIZE, SIZE)


def gaussians(n: int = 60, seed: int = 0) -> Gaussians[torch.Tensor]:
    """Small, fairly opaque blobs in a ball of radius about 0.7; the last fifth lies outside every camera's view."""
    g = torch.Generator().manual_seed(seed)
    means = torch.randn(n, 3, generator=g) * 0.35
    means[n - n // 5 :, 1] += 30.0
    return Gaussians(
        means=means,
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(n, 1),
        scales=torch.full((n, 3), -2.5),
        opacities=torch.full((n,), 0.5),
        sh0=torch.randn(n, 1, 3, generator=g),
        shN=torch.zeros(n, 0, 3),
    )


def images(scene: Gaussians[torch.Tensor], cameras: Cameras) -> list[torch.Tensor]:
    """What the cameras see, without noise."""
    with torch.no_grad():
        return [RENDERER.render(scene, cameras, v, BLACK).image for v in range(len(cameras))]


@dataclasses.dataclass(frozen=True)
class Context:
    """A FrameContext over given images, with the reference renderer behind it."""

    gaussians: Gaussians[torch.Tensor]
    cameras: Cameras
    before: list[torch.Tensor]
    now: list[torch.Tensor]
    sigma: float = 0.0
    index: int = 1

    @property
    def hierarchy(self) -> Hierarchy:
        index = torch.arange(len(self.gaussians))
        return Hierarchy(index, index, torch.zeros_like(index))

    def image(self, view: int) -> torch.Tensor:
        return self.now[view]

    def previous_image(self, view: int) -> torch.Tensor:
        return self.before[view]

    def previous_render(self, view: int) -> torch.Tensor:
        with torch.no_grad():
            return RENDERER.render(self.gaussians, self.cameras, view, BLACK).image

    def screen_gradient(self, view: int, image_gradient: torch.Tensor) -> ScreenGradient:
        return RENDERER.screen_gradient(self.gaussians, self.cameras, view, image_gradient)

    def noise_sigma(self, view: int) -> float:
        return self.sigma


@dataclasses.dataclass(frozen=True)
class Told(Context):
    """A context whose screen gradients are dictated: gradient [V, N, 2], visible [V, N]."""

    gradient: torch.Tensor | None = None
    visible: torch.Tensor | None = None

    def screen_gradient(self, view: int, image_gradient: torch.Tensor) -> ScreenGradient:
        assert self.gradient is not None
        assert self.visible is not None
        return ScreenGradient(self.gradient[view], self.visible[view])


def told(gradient: torch.Tensor, visible: torch.Tensor | None = None) -> Told:
    """Dictate gradients [V, N, 2]."""
    views, n = gradient.shape[:2]
    seen = torch.ones(views, n, dtype=torch.bool) if visible is None else visible
    blank = [torch.zeros(SIZE, SIZE, 3)] * views
    return Told(gaussians(n), rig(views), blank, blank, gradient=gradient, visible=seen)


@functools.cache
def moving(shift: float = 0.08, strength: float = 1.0) -> tuple[Context, torch.Tensor]:
    """One ball of 60 Gaussians of which those with x > 0.15 shift; the truth [N] bool (only those in view)."""
    scene, cameras = gaussians(), rig()
    moved = (scene.means[:, 0] > 0.15) & (scene.means[:, 1] < 5)
    means = scene.means.clone()
    means[moved, 1] += shift
    before, after = images(scene, cameras), images(dataclasses.replace(scene, means=means), cameras)
    now = [b + strength * (a - b) for a, b in zip(after, before, strict=True)]
    return Context(scene, cameras, before, now), moved
