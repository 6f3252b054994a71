"""Lenses: images of cameras with distortion, resampled as pinhole images while they are read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from gsstream.core.errors import SourceError
from gsstream.core.shapes import FloatArray

_SIDES, _RINGS = 64, 24
#: Bounds of the new focal length, as a factor: pictures are not stretched or cut more than this.
_WIDEST, _NARROWEST = 0.25, 2.0


@dataclass(frozen=True, slots=True)
class Lens:
    """How a camera bends rays, on coordinates x / z, y / z."""

    #: "radial": Brown-Conrady, as OpenCV's pinhole model; "fisheye": equidistant, as OpenCV's fisheye model.
    kind: Literal["radial", "fisheye"]
    k: tuple[float, ...]  # radial coefficients k1, k2, ...; of "radial", k4 to k6 divide (OpenCV's rational model)
    p: tuple[float, float] = (0.0, 0.0)  # tangential coefficients p1, p2 ("radial" only)

    @property
    def is_identity(self) -> bool:
        """A fisheye never is: even with coefficients of zero it maps angles, not tangents."""
        return self.kind == "radial" and not any((*self.k, *self.p))

    def distort(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return where this lens puts ideal pinhole coordinates."""
        square = x * x + y * y
        if self.kind == "fisheye":
            radius = np.sqrt(square)
            theta = np.arctan(radius)
            bent = theta * (1 + _series(theta * theta, self.k))
            factor = np.where(radius > 1e-12, bent / np.where(radius > 1e-12, radius, 1.0), 1.0)
            return x * factor, y * factor
        factor = (1 + _series(square, self.k[:3])) / (1 + _series(square, self.k[3:6]))
        p1, p2 = self.p
        return (
            x * factor + 2 * p1 * x * y + p2 * (square + 2 * x * x),
            y * factor + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
        )


def _series(square: FloatArray, coefficients: tuple[float, ...]) -> FloatArray:
    total = np.zeros_like(square)
    for coefficient in reversed(coefficients):
        total = (total + coefficient) * square
    return total


def pinhole_intrinsics(lens: Lens, K: FloatArray, size: tuple[int, int], where: str) -> FloatArray:
    """Return intrinsics [3, 3] of the widest pinhole image without empty corners, same size and principal point.

    Raises SourceError when no such image exists (coefficients that fold the picture over itself).
    """
    width, height = size
    steps = np.linspace(0, 1, _SIDES)
    zero, one = np.zeros(_SIDES), np.ones(_SIDES)
    u = np.concatenate([steps, steps, zero, one]) * width
    v = np.concatenate([zero, one, steps, steps]) * height

    shares = np.linspace(0, 1, _RINGS)[1:, None]

    def fits(zoom: float) -> bool:
        rings = K[0, 2] + (u - K[0, 2]) * shares, K[1, 2] + (v - K[1, 2]) * shares
        at_u, at_v = _source(lens, K, zoom, *rings)
        inside = (at_u[-1] >= 0) & (at_u[-1] <= width) & (at_v[-1] >= 0) & (at_v[-1] <= height)
        # Farther out in the result must be farther out in the picture, else the lens model folds the picture over
        # itself.
        outwards = np.diff(np.hypot(at_u - K[0, 2], at_v - K[1, 2]), axis=0) > 0
        return bool(inside.all() and outwards[:, (u != K[0, 2]) | (v != K[1, 2])].all())

    low, high = _WIDEST, _NARROWEST
    if not fits(high):
        raise SourceError(
            f"{where}: the distortion {lens.kind} k = {list(lens.k)}, p = {list(lens.p)} leaves no usable picture; "
            "check the coefficients and their order"
        )
    while high - low > 1e-4:
        middle = (low + high) / 2
        low, high = (low, middle) if fits(middle) else (middle, high)
    out: FloatArray = np.array(K, np.float64)
    out[0, 0] *= high
    out[1, 1] *= high
    return out


def _source(lens: Lens, K: FloatArray, zoom: float, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels of the zoomed pinhole image -> pixels of the distorted image."""
    x, y = lens.distort((u - K[0, 2]) / (K[0, 0] * zoom), (v - K[1, 2]) / (K[1, 1] * zoom))
    return K[0, 0] * x + K[0, 2], K[1, 1] * y + K[1, 2]


class Undistorter:
    """Resamples images of one camera from ``K`` [3, 3] to ``pinhole`` [3, 3], same size; the map is computed once."""

    def __init__(self, lens: Lens, K: FloatArray, pinhole: FloatArray, size: tuple[int, int]) -> None:
        width, height = size
        u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        x, y = lens.distort((u - pinhole[0, 2]) / pinhole[0, 0], (v - pinhole[1, 2]) / pinhole[1, 1])
        # Indices of pixels: the centre of the first one is 0 here.
        self._u: FloatArray = (K[0, 0] * x + K[0, 2] - 0.5).astype(np.float32)
        self._v: FloatArray = (K[1, 1] * y + K[1, 2] - 0.5).astype(np.float32)

    def __call__(self, image: FloatArray) -> FloatArray:
        """[H, W, 3] float32 -> [H, W, 3] float32, bilinear; the outermost half pixel repeats the border."""
        height, width = image.shape[:2]
        u, v = np.clip(self._u, 0, width - 1), np.clip(self._v, 0, height - 1)
        left, top = np.minimum(u.astype(np.int32), width - 2), np.minimum(v.astype(np.int32), height - 2)
        a, b = (u - left)[..., None], (v - top)[..., None]
        flat = np.ascontiguousarray(image).reshape(-1, 3)
        at = top * width + left
        upper = flat[at] * (1 - a) + flat[at + 1] * a
        lower = flat[at + width] * (1 - a) + flat[at + width + 1] * a
        out: FloatArray = (upper * (1 - b) + lower * b).astype(np.float32)
        return out
