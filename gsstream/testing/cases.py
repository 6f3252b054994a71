"""Tiny seeded worlds, made on the CPU, on which parts are checked."""

from __future__ import annotations

import copy
import dataclasses
import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from gsstream.core.cameras import Cameras
from gsstream.core.context import RowGradient, ScreenGradient
from gsstream.core.frame import PointCloud
from gsstream.core.gaussians import Gaussians
from gsstream.core.hierarchy import Hierarchy
from gsstream.parts.backend.reference import ReferenceRenderer
from gsstream.parts.structure.base import Anchors

RENDERER = ReferenceRenderer()
BLACK = (0.0, 0.0, 0.0)
SIZE = 20
Scene = Gaussians[torch.Tensor]
_GRADIENTS: dict[bytes, ScreenGradient] = {}


@dataclass(frozen=True)
class World:
    """One case; also the frame context that confidence estimators are given.

    Arguments:
        before, now: images of the two frames, one [H, W, 3] per camera.
        moving_mask: [N] bool, the truth about what moved.
        logits: [N] some confidence.
        residual: [N, 3] some position residual, cells.
        hierarchy: three trees of two levels; flat when there are fewer than twelve Gaussians.
        points, anchors: what a structure is given.
        sigma: noise of every camera as the context reports it, full scale 1.
    """

    name: str
    gaussians: Scene
    cameras: Cameras
    before: tuple[torch.Tensor, ...]
    now: tuple[torch.Tensor, ...]
    moving_mask: torch.Tensor
    logits: torch.Tensor
    residual: torch.Tensor
    hierarchy: Hierarchy
    points: PointCloud
    anchors: Anchors
    index: int = 1
    sigma: float = 0.002

    def image(self, view: int) -> torch.Tensor:
        return self.now[view]

    def previous_image(self, view: int) -> torch.Tensor:
        return self.before[view]

    def image_change(self, view: int) -> torch.Tensor:
        return self.now[view] - self.before[view]

    def previous_render(self, view: int) -> torch.Tensor:
        with torch.no_grad():
            return RENDERER.render(self.gaussians.map(torch.Tensor.detach), self.cameras, view, BLACK).image

    def screen_gradient(self, view: int, image_gradient: torch.Tensor) -> ScreenGradient:
        upstream = image_gradient.float()
        rig = self.cameras.select([view])
        key = b"".join(fingerprint((self.gaussians.map(torch.Tensor.detach), rig, upstream)))
        if key not in _GRADIENTS:
            # Many checks ask for the same gradient of the same world; the renderer is a pure function.
            _GRADIENTS[key] = RENDERER.screen_gradient(self.gaussians, rig, 0, upstream)
        return ScreenGradient(*(value.clone() for value in _GRADIENTS[key]))

    def screen_gradient_rows(self, view: int, image_gradient: torch.Tensor) -> RowGradient:
        gradient, visible = self.screen_gradient(view, image_gradient)
        rows = visible.nonzero()[:, 0]
        return RowGradient(rows, gradient[rows])

    def noise_sigma(self, view: int) -> float:
        return self.sigma

    def blended(self, share: float) -> World:
        """Return the same world with only a share of the change between the frames."""
        pairs = zip(self.before, self.now, strict=True)
        return replace(self, now=tuple(b + share * (n - b) for b, n in pairs))

    def views(self, order: list[int]) -> World:
        """Return the same world with the cameras in another order, or fewer of them."""
        before, now = (tuple(images[i] for i in order) for images in (self.before, self.now))
        return replace(self, cameras=self.cameras.select(order), before=before, now=now)

    def permuted(self, order: torch.Tensor) -> World:
        """Return the same world with the Gaussians in another order."""
        return replace(
            self,
            gaussians=self.gaussians.rows(order),
            moving_mask=self.moving_mask[order],
            logits=self.logits[order],
            residual=self.residual[order],
            hierarchy=self.hierarchy.rows(order),
            anchors=replace(
                self.anchors,
                positions=self.anchors.positions[order],
                colors=self.anchors.colors[order],
                levels=self.anchors.levels[order],
            ),
        )

    def double(self) -> World:
        """Return the same world with logits and residuals in double precision."""
        return replace(self, logits=self.logits.double(), residual=self.residual.double())


def rig(views: int = 3) -> Cameras:
    """Return cameras on an arc of radius 3 around the origin, looking inwards."""
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


def scene(
    means: torch.Tensor, seed: int = 0, scales: torch.Tensor | None = None, quats: torch.Tensor | None = None
) -> Scene:
    """Return small, fairly opaque blobs of random colours, round ones unless ``scales`` (logarithms) say else."""
    n = len(means)
    g = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=means,
        quats=torch.tensor([1.0, 0, 0, 0]).repeat(n, 1) if quats is None else quats,
        scales=torch.full((n, 3), -2.5) if scales is None else scales,
        opacities=torch.full((n,), 0.5),
        sh0=torch.randn(n, 1, 3, generator=g),
        shN=torch.zeros(n, 0, 3),
    )


def flat(n: int) -> Hierarchy:
    """Return one root node per Gaussian."""
    index = torch.arange(n)
    return Hierarchy(index, index, torch.zeros_like(index))


def forest(n: int) -> Hierarchy:
    """Return three trees: nodes 0 to 2 are roots, nodes 3 to 14 their children (four each).

    It is flat below twelve Gaussians.
    """
    if n < 12:
        return flat(n)
    parent = torch.cat([torch.arange(3), torch.arange(12) % 3])
    return Hierarchy(torch.arange(n) * 7 % 12 + 3, parent, torch.tensor([0] * 3 + [1] * 12))


def make_case(name: str, before: Scene, cameras: Cameras, *, shift: float = 0.0) -> World:
    """Return a world whose Gaussians with x > 0.3 and in view move by ``shift`` between the frames.

    Arguments:
        name: name of the world.
        before: its Gaussians in the frame before.
        cameras: that see it.
        shift: [3] scene units.
    """
    n = len(before)
    moving_mask = (before.means[:, 0] > 0.3) & (before.means[:, 1].abs() < 5) & (shift != 0)
    means = before.means.clone()
    means[moving_mask, 1] += shift
    g = torch.Generator().manual_seed(n + 1)
    xyz, rgb = before.means.numpy().copy(), torch.rand(n, 3, generator=g)
    levels = torch.arange(n) % 2
    sizes = torch.tensor([0.5, 0.25]) * max(1.0, float(before.means.abs().max()) if n else 1.0)
    origin = before.means.amin(0) - 0.1 if n else torch.zeros(3)
    return World(
        name,
        before,
        cameras,
        images(before, cameras),
        images(replace(before, means=means), cameras),
        moving_mask,
        3 * torch.randn(n, generator=g),
        torch.randn(n, 3, generator=g),
        forest(n),
        PointCloud(xyz, rgb.numpy(), name),
        Anchors(before.means.clone(), rgb, levels, sizes, origin),
    )


def images(gaussians: Scene, cameras: Cameras) -> tuple[torch.Tensor, ...]:
    """Return the images of the cameras, without noise: one [H, W, 3] each, by the reference renderer."""
    with torch.no_grad():
        return tuple(RENDERER.render(gaussians, cameras, view, BLACK).image for view in range(len(cameras)))


def _cloud(n: int = 200, seed: int = 0) -> torch.Tensor:
    return torch.randn(n, 3, generator=torch.Generator().manual_seed(seed)) * 0.35


def _line() -> torch.Tensor:
    return torch.linspace(-0.6, 0.6, 20)[:, None] * torch.ones(3)


def _unseen() -> torch.Tensor:
    means = _cloud(60)
    means[::2, 1] += 30.0
    return means


def _thin() -> Scene:
    means = _cloud(40)
    means[:, 2] = 0.0
    return scene(means, scales=torch.tensor([-2.5, -2.5, -12.0]).repeat(40, 1))


def _ellipsoids() -> Scene:
    """Three different sizes and turned axes: turning a ball changes nothing, and no check would see a wrong turn."""
    g = torch.Generator().manual_seed(7)
    scales = torch.tensor([-2.1, -2.5, -3.1]) + 0.1 * torch.randn(200, 3, generator=g)
    return scene(_cloud(), scales=scales, quats=torch.randn(200, 4, generator=g))


def _moving(name: str, views: int = 3) -> World:
    return make_case(name, scene(_cloud()), rig(views), shift=0.08)


def _sized(name: str, factor: float) -> World:
    """A cloud, its points and its cameras in another unit of length: its images are the same."""
    base = make_case(name, scene(_cloud(30)), rig(), shift=0.08)
    blobs, cameras, anchors, viewmats = base.gaussians, base.cameras, base.anchors, base.cameras.viewmats.copy()
    viewmats[:, :3, 3] *= factor
    lengths = {key: factor * getattr(anchors, key) for key in ("positions", "cell_sizes", "origin")}
    return replace(
        base,
        gaussians=replace(blobs, means=factor * blobs.means, scales=blobs.scales + math.log(factor)),
        cameras=replace(cameras, viewmats=viewmats, near_plane=factor * cameras.near_plane),
        points=replace(base.points, xyz=np.float32(factor) * base.points.xyz),
        anchors=replace(anchors, **lengths),
    )


def _sure(name: str, size: float) -> World:
    return replace(base := make_case(name, scene(_cloud(24)), rig()), logits=size * torch.sign(base.logits))


WORLDS: dict[str, Callable[[], World]] = {
    "empty": lambda: make_case("empty", scene(torch.zeros(0, 3)), rig()),
    "one": lambda: make_case("one", scene(torch.tensor([[0.1, 0.0, 0.0]])), rig()),
    "coincident": lambda: make_case("coincident", scene(torch.full((40, 3), 0.25)), rig()),
    "two identical": lambda: make_case("two identical", scene(torch.full((2, 3), 0.1)), rig()),
    "line": lambda: make_case("line", scene(_line()), rig(), shift=0.05),
    "cloud": lambda: make_case("cloud", _ellipsoids(), rig(), shift=0.08),
    "far": lambda: make_case("far", scene(_cloud(30) + 1e6), rig()),
    "tiny": lambda: _sized("tiny", 1e-6),
    "vast": lambda: _sized("vast", 1e6),
    "thin": lambda: make_case("thin", _thin(), rig(), shift=0.05),
    "static": lambda: make_case("static", scene(_cloud()), rig()),
    "moving": lambda: _moving("moving"),
    "unseen": lambda: make_case("unseen", scene(_unseen()), rig(), shift=0.08),
    "one camera": lambda: _moving("one camera", 1),
    "logits of 20": lambda: _sure("logits of 20", 20.0),
    "logits of 100": lambda: _sure("logits of 100", 100.0),
    "huge logits": lambda: _sure("huge logits", 1e4),
}

#: Extreme worlds; every part of a kind with ``behaviour`` is tried on each.
EXTREMES = (
    "empty", "one", "two identical", "coincident", "line", "far", "tiny", "vast", "thin", "unseen", "one camera",
    "logits of 20", "logits of 100", "huge logits",
)  # fmt: skip


@functools.cache
def _made(name: str) -> World:
    return WORLDS[name]()


def get_case(name: str) -> World:
    """Return a fresh copy of a named world, so that a part that spoils its inputs does not spoil another's."""
    return copy.deepcopy(_made(name))


def fingerprint(value: Any) -> list[bytes]:
    """Return the bits of every array inside a value, in a fixed order."""
    if isinstance(value, torch.Tensor):
        return [value.detach().numpy().tobytes(), str((value.dtype, tuple(value.shape), value.requires_grad)).encode()]
    if isinstance(value, np.ndarray):
        return [value.tobytes()]
    if isinstance(value, tuple):
        return [bits for item in value for bits in fingerprint(item)]
    if dataclasses.is_dataclass(value):
        return [bits for f in dataclasses.fields(value) for bits in fingerprint(getattr(value, f.name))]
    return []
