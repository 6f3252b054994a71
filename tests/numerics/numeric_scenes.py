"""What the numeric tests share: how many examples to try, scenes of any precision, contexts with dictated gradients."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from hypothesis import settings

from gsstream.core.cameras import Cameras
from gsstream.core.gaussians import Gaussians
from gsstream.testing.cases import make_case, rig, scene
from tests.scenes import Dictated

Scene = Gaussians[torch.Tensor]
#: GSSTREAM_TEST_EXAMPLES=1000 makes a job of the matrix: at least so many examples for every property.
EXAMPLES = int(os.environ.get("GSSTREAM_TEST_EXAMPLES", "0"))


def some(examples: int) -> settings:
    """Settings of a property test: its own number of examples, more in the long version."""
    return settings(max_examples=max(examples, EXAMPLES), deadline=None)


def draws(runs: int) -> range:
    """Seeds of a measurement: its own number, more in the long version."""
    return range(max(runs, EXAMPLES // 20))


def camera(
    focal: float = 50.0, width: int = 33, height: int = 20, center: Sequence[float] | None = None, near: float = 0.01
) -> Cameras:
    """One camera three units before the origin, looking at it."""
    viewmat = np.eye(4)
    viewmat[2, 3] = 3.0
    cx, cy = (width / 2, height / 2) if center is None else center
    K = np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1.0]])
    return Cameras(("c",), viewmat[None], K[None], width, height, near)


def blobs(
    means: Any, scales: Any = -2.0, quats: Any = (1.0, 0.3, -0.2, 0.5), opacities: Any = 1.0, sh0: Any = (1.0, 0.5, 0.2)
) -> Scene:
    """Gaussians at ``means`` [N, 3], float32; everything else is broadcast to them."""
    at = torch.as_tensor(means, dtype=torch.float32).reshape(-1, 3)
    n = len(at)

    def full(value: Any, *shape: int) -> torch.Tensor:
        return torch.as_tensor(value, dtype=torch.float32).expand(n, *shape).clone()

    return Gaussians(at, full(quats, 4), full(scales, 3), full(opacities), full(sh0, 3)[:, None], torch.zeros(n, 0, 3))


def random_scene(seed: int, n: int = 40, bases: int = 9) -> Scene:
    """Ordinary Gaussians around the origin, float32."""
    g = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.rand(n, 3, generator=g) * 1.6 - 0.8,
        quats=torch.randn(n, 4, generator=g),
        scales=torch.log(0.03 + 0.3 * torch.rand(n, 3, generator=g).square()),
        opacities=1.5 * torch.randn(n, generator=g),
        sh0=0.4 * torch.randn(n, 1, 3, generator=g),
        shN=0.2 * torch.randn(n, bases - 1, 3, generator=g),
    )


def upstream(cameras: Cameras, seed: int = 0) -> torch.Tensor:
    """[H, W, 3] some gradient of an image, float32."""
    return torch.randn(cameras.height, cameras.width, 3, generator=torch.Generator().manual_seed(seed))


def rendered(renderer: Any, gaussians: Scene, cameras: Cameras, grad: torch.Tensor) -> tuple[torch.Tensor, Scene]:
    """Image and gradients of sum(image * grad), in the precision of the Gaussians, given back as float64."""
    leaves = gaussians.map(lambda value: value.detach().clone().requires_grad_())
    image = renderer.render(leaves, cameras, 0, (0.2, 0.5, 0.9)).image
    (image * grad.to(image.dtype)).sum().backward()
    none = leaves.map(lambda leaf: torch.zeros_like(leaf) if leaf.grad is None else leaf.grad)
    return image.detach().double(), none.map(torch.Tensor.double)


def worst(got: torch.Tensor, want: torch.Tensor, floor: float = 0.0) -> float:
    """Largest error relative to the largest value wanted (at least ``floor``); both equal and zero: 0."""
    if want.numel() == 0:
        return 0.0
    assert bool(torch.isfinite(got).all()), "a value is not finite"
    error, scale = float((got.double() - want.double()).abs().max()), max(float(want.abs().max()), floor)
    return error / scale if scale > 0 else (0.0 if error == 0 else math.inf)


def dictated(magnitudes: Any) -> Dictated:
    """One camera that feels gradients of these lengths [N], along x, in pixels; float32."""
    lengths = torch.as_tensor(magnitudes, dtype=torch.float32).reshape(-1)
    n = len(lengths)
    base = make_case("dictated", scene(torch.zeros(n, 3)), rig(1))
    return Dictated.of(base, torch.stack([lengths, torch.zeros(n)], 1)[None])
