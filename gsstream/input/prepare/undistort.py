"""From a real lens to a pinhole: a map per camera, made once, applied to every picture (kornia's remap)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from gsstream.core.errors import InputError
from gsstream.core.shapes import FloatArray
from gsstream.input.seeds.mapping import Lens, lens_places

#: How far the pinhole's field of view may be narrowed until no pixel lies outside of the raw picture.
ZOOMS = np.geomspace(0.7, 3.0, 60)


@dataclass(frozen=True, slots=True)
class Undistortion:
    """How pinhole pictures are made of raw ones."""

    K: FloatArray  # [3, 3] of the pinhole pictures
    places: FloatArray  # [factor H, factor W, 2] where each sample lies in the raw picture, pixels
    #: Samples per pixel and axis. A pixel is the mean of its samples; one alone would skip raw pixels, which
    #: flickers, where pictures are shrunk.
    factor: int = 1

    def apply(self, image: FloatArray) -> FloatArray:
        """Return the [H, W, 3] pinhole picture of a raw one, bilinear, in [0, 1]."""
        from kornia.geometry.transform import remap

        at = torch.from_numpy(self.places - 0.5).float()  # kornia counts from the centre of the first pixel
        planes = torch.from_numpy(image).permute(2, 0, 1)[None]
        out = remap(planes, at[None, ..., 0], at[None, ..., 1], mode="bilinear", align_corners=True)
        out = torch.nn.functional.avg_pool2d(out, self.factor)
        return np.ascontiguousarray(out[0].permute(1, 2, 0).numpy())


def undistortion(lens: Lens, size: tuple[int, int], target: tuple[int, int]) -> Undistortion:
    """Return the widest pinhole of ``target`` pixels that sees only what the lens saw, with its principal point.

    Raises InputError when no pinhole up to three times the lens's focal length is covered (a wrong lens model).
    """
    base = cut_to(lens.K, size, target)
    K = _widest(lens, base, size, target) if lens.distorts else base
    factor = math.ceil(1 / cut_to(np.eye(3), size, target)[0, 0] - 1e-9)
    width, height = factor * target[0], factor * target[1]
    x, y = np.meshgrid((np.arange(width) + 0.5) / factor, (np.arange(height) + 0.5) / factor)
    rays = _rays(np.stack([x.ravel(), y.ravel()], axis=1), K)
    return Undistortion(K, lens_places(lens, size, rays).reshape(height, width, 2), factor)


def cut_to(K: FloatArray, size: tuple[int, int], target: tuple[int, int]) -> FloatArray:
    """Return intrinsics [3, 3] of pictures shrunk evenly until they cover ``target``, and cut around their middle."""
    across, down = target[0] / size[0], target[1] / size[1]
    if abs(across * size[1] - target[1]) < 1:
        scaled: FloatArray = np.diag([across, down, 1.0]) @ K
        return scaled
    factor = max(across, down)
    out: FloatArray = np.diag([factor, factor, 1.0]) @ K
    out[:2, 2] -= (factor * np.array(size) - np.array(target)) / 2
    return out


def _widest(lens: Lens, base: FloatArray, size: tuple[int, int], target: tuple[int, int]) -> FloatArray:
    border = _border(*target)
    tried = [_rays(border, _zoomed(base, zoom)) for zoom in ZOOMS]
    places = lens_places(lens, size, np.concatenate(tried)).reshape(len(ZOOMS), -1, 2)
    inside = np.asarray(((places >= 0) & (places <= np.array(size))).all(axis=(1, 2)))
    # Searched from the narrow end: far outside of the picture a lens model may fold back and seem to be covered.
    covered = np.flatnonzero(~inside[::-1])
    first = len(ZOOMS) - int(covered[0]) if len(covered) else 0
    if first == len(ZOOMS):
        raise InputError(
            f"undistortion: no pinhole is covered by a {lens.model} lens with {np.round(lens.params, 4).tolist()} and "
            f"pictures of {size[0]} x {size[1]}; expected a lens that sees straight ahead. Check the lens model"
        )
    return _zoomed(base, float(ZOOMS[first]))


def _zoomed(K: FloatArray, zoom: float) -> FloatArray:
    out = K.copy()
    out[0, 0] *= zoom
    out[1, 1] *= zoom
    return out


def _rays(pixels: FloatArray, K: FloatArray) -> FloatArray:
    rays: FloatArray = (pixels - K[:2, 2]) / np.array([K[0, 0], K[1, 1]])
    return rays


def _border(width: int, height: int) -> FloatArray:
    """Pixel positions along the edges of a picture."""
    x, y = np.linspace(0, width, 33), np.linspace(0, height, 33)
    sides = [
        np.stack([x, np.zeros_like(x)], 1),
        np.stack([x, np.full_like(x, height)], 1),
        np.stack([np.zeros_like(y), y], 1),
        np.stack([np.full_like(y, width), y], 1),
    ]
    return np.concatenate(sides)
