"""Analytic shapes met by rays: where, with which normal, in which coordinates of their own (for texture). float32."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsstream.core.shapes import BoolArray, FloatArray

_FAR = np.float32(1e9)
_EPSILON = np.float32(1e-4)
_rng = np.random.default_rng(7)  # a private generator: fixed wave directions [3, 16], wave numbers from 0.4 to 5
_WAVES = _rng.normal(size=(3, 16))
_WAVES = (_WAVES / np.linalg.norm(_WAVES, axis=0) * np.geomspace(0.4, 5.0, 16)).astype(np.float32)
_SHIFTS = _rng.uniform(0.5, 5.0, 16).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Surface:
    """Look: ``color`` rgb in [0, 1]; ``contrast`` of the texture; ``frequency`` in radians per scene unit."""

    color: tuple[float, float, float]
    contrast: float = 0.35
    frequency: float = 18.0
    phase: float = 0.0

    def shade(self, local: FloatArray) -> FloatArray:
        """Return the albedo [P, 3] at local positions [P, 3]: waves in many directions, so that no patch repeats."""
        waves = np.sin(local @ (_WAVES * np.float32(self.frequency)) + _SHIFTS * np.float32(self.phase))
        tone = 1 + np.float32(self.contrast) * np.tanh(0.7 * waves.sum(1, dtype=np.float32))
        albedo: FloatArray = np.asarray(self.color, np.float32) * tone[:, None].astype(np.float32)
        return albedo


@dataclass(frozen=True, slots=True)
class Sphere:
    """A ball. ``radius`` in scene units."""

    name: str
    radius: float
    surface: Surface

    def distance(self, origin: FloatArray, rays: FloatArray, center: FloatArray) -> FloatArray:
        """Return [P]: ray parameter of the first hit in front of the origin, or 1e9."""
        offset = (origin - center).astype(np.float32)
        a = np.einsum("pi,pi->p", rays, rays)
        b = np.einsum("pi,pi->p", rays, np.broadcast_to(offset, rays.shape))
        c = np.einsum("...i,...i->...", offset, offset) - np.float32(self.radius**2)
        root = b * b - a * c
        hit = (-b - np.sqrt(np.maximum(root, 0))) / a
        return np.where((root > 0) & (hit > _EPSILON), hit, _FAR).astype(np.float32)

    def normal(self, local: FloatArray) -> FloatArray:
        """Return [P, 3] outward unit normals at positions relative to the centre."""
        return local / np.float32(self.radius)


@dataclass(frozen=True, slots=True)
class Box:
    """An axis-aligned box. ``half`` sides in scene units; ``room``: seen from inside."""

    name: str
    half: tuple[float, float, float]
    surface: Surface
    room: bool = False

    def distance(self, origin: FloatArray, rays: FloatArray, center: FloatArray) -> FloatArray:
        """Return [P]: ray parameter of the first hit in front of the origin, or 1e9 (slab method)."""
        offset = (origin - center).astype(np.float32)
        enter, leave = np.full(len(rays), -_FAR), np.full(len(rays), _FAR)
        # Axis by axis: numpy reduces over a last axis of three ten times slower than over columns.
        for axis, half in enumerate(self.half):
            # A ray parallel to a slab has an infinite crossing; a tiny component keeps the arithmetic finite.
            component = np.where(np.abs(rays[:, axis]) < 1e-9, np.float32(1e-9), rays[:, axis])
            inverse = 1 / component
            middle, reach = -offset[..., axis] * inverse, np.abs(np.float32(half) * inverse)
            np.maximum(enter, middle - reach, out=enter)
            np.minimum(leave, middle + reach, out=leave)
        hit = leave if self.room else enter
        return np.where((enter <= leave) & (hit > _EPSILON), hit, _FAR).astype(np.float32)

    def normal(self, local: FloatArray) -> FloatArray:
        """Return [P, 3] unit normals of the faces nearest to positions relative to the centre."""
        ratio = local / np.asarray(self.half, np.float32)
        face = np.abs(ratio).argmax(1)
        normals = np.zeros_like(local)
        rows = np.arange(len(local))
        normals[rows, face] = np.sign(ratio[rows, face]) * (-1 if self.room else 1)
        return normals


Shape = Sphere | Box
Placed = tuple[Shape, FloatArray]


@dataclass(frozen=True, slots=True)
class Hits:
    """First hits of P rays: ``distance`` [P] ray parameter, ``albedo`` [P, 3], ``normal`` [P, 3]."""

    distance: FloatArray
    albedo: FloatArray
    normal: FloatArray


def cast(origin: FloatArray, rays: FloatArray, shapes: list[Placed]) -> Hits:
    """Return the first hits of rays [P, 3] from one origin [3]; where nothing is hit, distance 1e9 and zeros."""
    distances = np.stack([shape.distance(origin, rays, center) for shape, center in shapes])
    first, distance = distances.argmin(0), distances.min(0)
    albedo, normal = np.zeros_like(rays), np.zeros_like(rays)
    for number, (shape, center) in enumerate(shapes):
        rows = np.flatnonzero((first == number) & (distance < _FAR))
        local = (origin - center).astype(np.float32) + rays[rows] * distance[rows, None]
        albedo[rows], normal[rows] = shape.surface.shade(local), shape.normal(local)
    return Hits(distance, albedo, normal)


def lit(points: FloatArray, light: FloatArray, shapes: list[Placed]) -> BoolArray:
    """Return [P] bool: no shape stands between a point and the light, which shines from direction ``light`` [3]."""
    rays = np.broadcast_to(light.astype(np.float32), points.shape)
    free = np.ones(len(points), bool)
    for shape, center in shapes:
        free &= shape.distance(points, rays, center) >= _FAR
    return free
