"""Scenes for the rasteriser tests, and the float64 reference they are compared with."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gsstream_cpu_render.arrays import SplatArrays, SplatGradients
from gsstream_cpu_render.rasterizer import NumpyRasterizer

from gsstream.api import Cameras, Gaussians
from gsstream.parts.backend.reference import composite, project

BACKGROUND = (0.2, 0.5, 0.9)
WIDTH, HEIGHT = 49, 37  # neither a multiple of a block nor of a tile
GRADIENT_TOLERANCE = 2e-5  # of the largest gradient of the attribute; float32 against float64
FLOOR = 1e-6  # far below the largest of any gradient here (4e-4 and more), far above rounding noise (1e-9)


def camera(width: int = WIDTH, height: int = HEIGHT, focal: float = 50.0) -> tuple[np.ndarray, np.ndarray]:
    """A slightly turned camera 3 units away, principal point off centre."""
    angle = 0.3
    viewmat = np.eye(4)
    viewmat[0, [0, 2]] = np.cos(angle), np.sin(angle)
    viewmat[2, [0, 2]] = -np.sin(angle), np.cos(angle)
    viewmat[2, 3] = 3.0
    K = np.array([[focal, 0, width / 2 + 0.7], [0, 0.95 * focal, height / 2 - 0.4], [0, 0, 1]])
    return viewmat.astype(np.float32).astype(np.float64), K.astype(np.float32).astype(np.float64)


def random_splats(n: int, seed: int, coefficients: int, opaque: bool = False) -> SplatArrays:
    """N Gaussians around the origin."""
    rng = np.random.default_rng(seed)
    means = rng.uniform([-1.3, -1.3, -1.0], [1.3, 1.3, 1.0], (n, 3))
    quats = rng.normal(size=(n, 4))
    scales = np.log(0.02 + 0.25 * rng.random((n, 3)) ** 2)
    opacities = rng.normal(size=n) * 1.5 + (2.0 if opaque else 0.0)
    sh = rng.normal(size=(n, coefficients, 3)) * 0.3
    return as_splats(means, quats, scales, opacities, sh[:, :1], sh[:, 1:])


def as_splats(*arrays: Any) -> SplatArrays:
    return SplatArrays(*(np.ascontiguousarray(a, np.float32) for a in arrays))


def rows_of(splats: SplatArrays, ids: Any) -> SplatArrays:
    return SplatArrays(*(np.ascontiguousarray(a[ids]) for a in splats))


def with_rows(splats: SplatArrays, ids: Any, rows: SplatArrays) -> SplatArrays:
    copies = SplatArrays(*(a.copy() for a in splats))
    for whole, part in zip(copies, rows, strict=True):
        whole[ids] = part
    return copies


def rasterizer(width: int = WIDTH, height: int = HEIGHT, focal: float = 50.0) -> NumpyRasterizer:
    return NumpyRasterizer(*camera(width, height, focal), width, height, BACKGROUND)


def upstream(seed: int, width: int = WIDTH, height: int = HEIGHT) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1000 + seed)
    return rng.normal(size=(height, width, 3)).astype(np.float32), rng.normal(size=(height, width)).astype(np.float32)


def reference(
    splats: SplatArrays, v_image: np.ndarray, v_alpha: np.ndarray, focal: float = 50.0
) -> tuple[np.ndarray, np.ndarray, SplatGradients]:
    """Image, transmittance and gradients by float64 autograd through gsstream's reference renderer."""
    height, width = v_alpha.shape
    viewmat, K = camera(width, height, focal)
    cameras = Cameras(("c",), viewmat[None], K[None], width, height)
    leaves = Gaussians(*(torch.tensor(a, dtype=torch.float64, requires_grad=True) for a in splats))
    probe = torch.zeros(len(splats.means), 2, dtype=torch.float64, requires_grad=True)
    means2d, conics, colors, depths, opacities = project(leaves, cameras, 0)
    order = torch.argsort(depths.detach(), stable=True)
    order = order[depths.detach()[order] > cameras.near_plane]
    parts = ((means2d + probe)[order], conics[order], colors[order], opacities[order])
    image, alpha = composite(*parts, 0, height, width, torch.tensor(BACKGROUND, dtype=torch.float64))
    ((image * torch.tensor(v_image)).sum() + (alpha * torch.tensor(v_alpha)).sum()).backward()
    tensors = [*(value for _, value in leaves.items()), probe]
    gradients = [torch.zeros_like(t) if t.grad is None else t.grad for t in tensors]
    return image.detach().numpy(), 1 - alpha.detach().numpy(), SplatGradients(*(g.numpy() for g in gradients))


def relative_error(got: np.ndarray, want: np.ndarray) -> float:
    """Largest error relative to the largest value wanted or FLOOR; an all-zero gradient must be met exactly."""
    if want.size == 0:
        return 0.0
    error, scale = float(np.abs(got - want).max()), float(np.abs(want).max())
    return error / max(scale, FLOOR) if scale > 0 else (0.0 if error == 0 else np.inf)


def equal_bits(a: tuple[np.ndarray, ...], b: tuple[np.ndarray, ...]) -> bool:
    """Whether bits are equal, not only values: a resumed run repeats the bytes of the stream, on any number of threads,
    so a cached pass and a full one may not differ by a rounding either.
    """
    return all(x.shape == y.shape and x.tobytes() == y.tobytes() for x, y in zip(a, b, strict=True))
