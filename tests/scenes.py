"""Scenes that tests of several folders share, and frames whose gradients or best motions are known."""

from __future__ import annotations

import dataclasses
from copy import copy
from typing import Any

import numpy as np
import torch

from gsstream.api import ATTRIBUTES, Cameras, Gaussians, Layout, Scene
from gsstream.backend import LossAndGrad, ScreenGradient, Wrt
from gsstream.core.changes import Displacement
from gsstream.core.log import FrameLog
from gsstream.testing import World

#: Two cameras in one place.
RIG = Cameras(("a", "b"), np.stack([np.eye(4)] * 2), np.tile(np.diag([50.0, 50, 1]), (2, 1, 1)), 32, 24)


def make_scene(number: int, bases: int = 4, seed: int = 0) -> Gaussians[np.ndarray]:
    """Gaussians whose raw values are all drawn from N(0, 1), float32."""
    g = np.random.default_rng(seed)
    shapes = [(number, 3), (number, 4), (number, 3), (number,), (number, 1, 3), (number, bases - 1, 3)]
    return Gaussians(**{k: g.normal(size=s).astype(np.float32) for k, s in zip(ATTRIBUTES, shapes, strict=True)})


def scene_at(means: np.ndarray, moved: Displacement | None = None, quats: np.ndarray | None = None) -> Scene:
    """Gaussians of one size in given places, every one a root; not turned unless ``quats`` say so."""
    number = len(means)
    gaussians = Gaussians(
        means=means.astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (number, 1)),
        scales=np.zeros((number, 3), np.float32),
        opacities=np.zeros(number, np.float32),
        sh0=np.zeros((number, 1, 3), np.float32),
        shN=np.zeros((number, 0, 3), np.float32),
    )
    if quats is not None:
        gaussians.quats[:] = quats
    return Scene(gaussians, Layout.flat(number, 1.0), moved)


class SquaredDistances:
    """A frame whose loss is the squared distance of every Gaussian to where it belongs, for tests of motions.

    Arguments:
        aims: [N, 3] where each belongs. changed: rows that changed; None: all.
        key_rows: Gaussians that frame 0 had; None: all.
    """

    cameras, index = RIG, 1

    def __init__(
        self, scene: Scene, aims: np.ndarray, changed: np.ndarray | None = None, key_rows: int | None = None
    ) -> None:
        self.gaussians, self.aims = scene.gaussians.map(torch.from_numpy), torch.from_numpy(aims.astype(np.float32))
        self.shell_rows = torch.zeros(len(aims), dtype=torch.bool)
        self.changed = np.arange(len(aims)) if changed is None else changed
        self.key_rows = len(aims) if key_rows is None else key_rows
        self.seen: list[np.ndarray] = []
        self.log = FrameLog()

    def changed_rows(self, min_votes: float) -> torch.Tensor:
        return torch.from_numpy(np.isin(np.arange(len(self.aims)), self.changed))

    def scaled(self, number: float) -> int:
        return round(number)

    def narrow(self, rows: torch.Tensor) -> None:
        self.rows = rows

    def loss_and_grad(self, view: int, wrt: Wrt[Any], tiles: str = "all") -> LossAndGrad[Any]:
        leaves = wrt.placed().map(lambda value: value.detach().requires_grad_())
        self.seen.append(leaves.means.detach().numpy().copy())
        loss = (leaves.means - self.aims[self.rows]).square().sum()
        loss.backward()
        return LossAndGrad(loss.detach(), wrt.grad(leaves))

    def on(self, gaussians: Gaussians[torch.Tensor]) -> SquaredDistances:
        assert len(gaussians) == self.key_rows
        other = copy(self)
        other.gaussians = gaussians
        return other


@dataclasses.dataclass(frozen=True)
class Dictated(World):
    """A frame context whose screen gradients are given: gradient [V, N, 2], visible [V, N]."""

    gradient: torch.Tensor = dataclasses.field(kw_only=True)
    visible: torch.Tensor = dataclasses.field(kw_only=True)

    @classmethod
    def of(cls, world: World, gradient: torch.Tensor, visible: torch.Tensor | None = None) -> Dictated:
        """Return the world with these gradients; every Gaussian is visible unless said otherwise."""
        seen = torch.ones(gradient.shape[:2], dtype=torch.bool) if visible is None else visible
        facts = {field.name: getattr(world, field.name) for field in dataclasses.fields(World)}
        return cls(**facts, gradient=gradient, visible=seen)

    def screen_gradient(self, view: int, image_gradient: torch.Tensor) -> ScreenGradient:
        return ScreenGradient(self.gradient[view], self.visible[view])
