"""Lenses: images of cameras with distortion, resampled as pinhole images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from gsstream.core.errors import SourceError
from gsstream.core.install_hints import require_encoder
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.images import shrink

_COLMAP = (
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "SIMPLE_FISHEYE", "FISHEYE",
    "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE", "FOV",
)  # fmt: skip
_SIDES, _RINGS = 64, 24
#: Bounds of the new focal length, as a factor: pictures are not stretched or cut more than this.
_WIDEST, _NARROWEST = 0.25, 2.0


@dataclass(frozen=True, slots=True)
class Lens:
    """How a camera bends rays, on coordinates x / z, y / z."""

    #: "radial": Brown-Conrady, as OpenCV's pinhole model; "fisheye": equidistant, as OpenCV's fisheye model; "fov":
    #: COLMAP's FOV, of Devernay and Faugeras.
    kind: Literal["radial", "fisheye", "fov"]
    #: Radial coefficients k1, k2, ...; of "radial", k4 to k6 divide (OpenCV's rational model); of "fov" its angle.
    k: tuple[float, ...]
    p: tuple[float, float] = (0.0, 0.0)  # tangential coefficients p1, p2
    s: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)  # those of a thin prism, s1 to s4 as OpenCV's
    #: Of "radial": the fourth radial coefficient of programs in which none divides (Metashape, RealityCapture).
    eighth: float = 0.0
    skew: float = 0.0  # how much of y is added to x, on bent coordinates

    @property
    def is_identity(self) -> bool:
        """A fisheye never is: even with coefficients of zero it maps angles, not tangents."""
        return self.kind != "fisheye" and not any((*self.k, *self.p, *self.s, self.eighth, self.skew))

    def distort(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return where this lens puts ideal pinhole coordinates."""
        radius = np.hypot(x, y)
        away = np.where(radius > 1e-12, radius, 1.0)  # no division by zero in the middle
        if self.kind == "fov":
            (angle,) = self.k
            slope = 2 * math.tan(angle / 2)
            factor = np.where(radius > 1e-12, np.arctan(radius * slope) / away, slope) / angle
            return x * factor, y * factor
        top, bottom = (*(*self.k[:3], 0.0, 0.0, 0.0)[:3], self.eighth), self.k[3:6]
        if self.kind == "fisheye":
            top, bottom, factor = self.k, (), np.where(radius > 1e-12, np.arctan(radius) / away, 1.0)
            x, y = x * factor, y * factor
        square = x * x + y * y
        factor = (1 + _series(square, top)) / (1 + _series(square, bottom))
        (p1, p2), (s1, s2, s3, s4) = self.p, self.s
        u = x * factor + 2 * p1 * x * y + p2 * (square + 2 * x * x) + _series(square, (s1, s2))
        v = y * factor + p1 * (square + 2 * y * y) + 2 * p2 * x * y + _series(square, (s3, s4))
        return u + self.skew * v, v


def _series(square: FloatArray, coefficients: tuple[float, ...]) -> FloatArray:
    total = np.zeros_like(square)
    for coefficient in reversed(coefficients):
        total = (total + coefficient) * square
    return total


def from_colmap(model: str, params: Sequence[float], where: str) -> tuple[FloatArray, Lens]:
    """Return K [3, 3] and the lens of a camera model by COLMAP's name, with COLMAP's parameters.

    Raises SourceError for models whose lens gsstream does not know.
    """
    p = tuple(map(float, params))
    if model not in _COLMAP:
        raise SourceError(f"{where}: the model {model} is not supported; undistort with COLMAP's own tool")
    single = model.startswith(("SIMPLE_", "RADIAL"))
    fx, fy, cx, cy = (p[0], p[0], p[1], p[2]) if single else p[:4]
    rest = p[3:] if single else p[4:]
    match model:
        case "SIMPLE_PINHOLE" | "PINHOLE":
            lens = Lens("radial", ())
        case "SIMPLE_RADIAL" | "RADIAL":
            lens = Lens("radial", rest)
        case "OPENCV":
            lens = Lens("radial", rest[:2], (rest[2], rest[3]))
        case "FULL_OPENCV":
            lens = Lens("radial", (*rest[:2], *rest[4:8]), (rest[2], rest[3]))
        case "THIN_PRISM_FISHEYE":
            lens = Lens("fisheye", (*rest[:2], *rest[4:6]), (rest[2], rest[3]), (rest[6], 0.0, rest[7], 0.0))
        case "FOV":
            if not abs(rest[0]) < math.pi:
                raise SourceError(f"{where}: the angle of the model FOV must be below pi, got {rest[0]:g}")
            lens = Lens("fov", rest) if rest[0] else Lens("radial", ())
        case _:
            lens = Lens("fisheye", rest)
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), lens


@dataclass(frozen=True, slots=True)
class Undistortion:
    """How pinhole pictures are made of raw ones; the map is computed once."""

    K: FloatArray  # [3, 3] of the pinhole pictures
    size: tuple[int, int]  # (width, height) to which raw pictures are area-averaged first
    #: [H, W, 2] float32: where each pixel lies in the picture of that size, pixels from its corner.
    places: FloatArray

    def apply(self, image: FloatArray) -> FloatArray:
        """Return the [H, W, 3] float32 pinhole picture of a raw one, bilinear; its outermost half pixel is repeated."""
        import torch
        from kornia.geometry.transform import remap

        if image.shape[1::-1] != self.size:
            image = shrink(image, self.size)
        at = torch.from_numpy(self.places - np.float32(0.5))[None]  # kornia counts from the centre of the first pixel
        planes = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None]
        out = remap(planes, at[..., 0], at[..., 1], mode="bilinear", padding_mode="border", align_corners=True)
        return np.ascontiguousarray(out[0].permute(1, 2, 0).numpy())


def undistortion(lens: Lens, K: FloatArray, size: tuple[int, int], target: tuple[int, int], where: str) -> Undistortion:
    """Return the widest pinhole of ``target`` pixels that sees only what the lens saw, with its principal point.

    ``K`` [3, 3] is for raw pictures of ``size``, which are shrunk evenly until they cover ``target`` and cut around
    their middle. Raises SourceError when no pinhole is covered (coefficients that fold the picture over itself).
    """
    require_encoder()
    factor = max(target[0] / size[0], target[1] / size[1])
    same = abs(target[0] * size[1] / size[0] - target[1]) < 1
    shrunk = target if same else (round(factor * size[0]), round(factor * size[1]))
    scale = np.array(shrunk) / np.array(size)
    margin = (np.array(shrunk) - np.array(target)) / 2
    zoom = 1.0 if lens.is_identity else _zoom(lens, K, size, margin / scale, (margin + target) / scale, where)
    raw, pinhole = np.diag([*scale, 1.0]) @ K, np.diag([*scale, 1.0]) @ K
    pinhole[[0, 1], [0, 1]] *= zoom
    pinhole[:2, 2] -= margin
    u, v = np.meshgrid(np.arange(target[0]) + 0.5, np.arange(target[1]) + 0.5)
    x, y = lens.distort((u - pinhole[0, 2]) / pinhole[0, 0], (v - pinhole[1, 2]) / pinhole[1, 1])
    places = np.stack([raw[0, 0] * x + raw[0, 2], raw[1, 1] * y + raw[1, 2]], axis=-1)
    return Undistortion(pinhole, shrunk, places.astype(np.float32))


def _zoom(lens: Lens, K: FloatArray, size: tuple[int, int], first: FloatArray, last: FloatArray, where: str) -> float:
    """The least factor on the focal lengths with which the lens saw all from one corner to the other, raw pixels."""
    width, height = size
    steps = np.linspace(0, 1, _SIDES)
    zero, one = np.zeros(_SIDES), np.ones(_SIDES)
    u = first[0] + np.concatenate([steps, steps, zero, one]) * (last[0] - first[0])
    v = first[1] + np.concatenate([zero, one, steps, steps]) * (last[1] - first[1])

    shares = np.linspace(0, 1, _RINGS)[1:, None]

    def fits(zoom: float) -> bool:
        x, y = (u - K[0, 2]) * shares / (K[0, 0] * zoom), (v - K[1, 2]) * shares / (K[1, 1] * zoom)
        bent = lens.distort(x, y)
        at_u, at_v = K[0, 0] * bent[0] + K[0, 2], K[1, 1] * bent[1] + K[1, 2]
        inside = (at_u[-1] >= 0) & (at_u[-1] <= width) & (at_v[-1] >= 0) & (at_v[-1] <= height)
        # Farther out in the result must be farther out in the picture, else the lens model folds the picture over
        # itself.
        outwards = np.diff(np.hypot(at_u - K[0, 2], at_v - K[1, 2]), axis=0) > 0
        return bool(inside.all() and outwards[:, (u != K[0, 2]) | (v != K[1, 2])].all())

    low, high = _WIDEST, _NARROWEST
    if not fits(high):
        raise SourceError(
            f"{where}: the distortion {lens.kind} k = {list(lens.k)}, p = {list(lens.p)}, s = {list(lens.s)} leaves no "
            "usable picture; check the coefficients and their order"
        )
    while high - low > 1e-4:
        middle = (low + high) / 2
        low, high = (low, middle) if fits(middle) else (middle, high)
    return high
