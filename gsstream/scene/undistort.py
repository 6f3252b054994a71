"""From a real lens to a pinhole: a map per camera, made once, applied to every picture (kornia's remap)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from gsstream.core.errors import InputError
from gsstream.core.shapes import FloatArray
from gsstream.init.mapping import Lens, lens_places

#: How far the pinhole's field of view may be narrowed until no pixel lies outside of the raw picture.
ZOOMS = np.geomspace(0.7, 3.0, 60)


@dataclass(frozen=True, slots=True)
class Undistortion:
    """``K`` [3, 3] of the pinhole pictures; ``places`` [H, W, 2] where each of their pixels lies in the raw picture."""

    K: FloatArray
    places: FloatArray

    def apply(self, image: FloatArray) -> FloatArray:
        """[H, W, 3] pinhole picture of a raw one, bilinear, in [0, 1]."""
        from kornia.geometry.transform import remap

        at = torch.from_numpy(self.places - 0.5).float()  # kornia counts from the centre of the first pixel
        planes = torch.from_numpy(image).permute(2, 0, 1)[None]
        out = remap(planes, at[None, ..., 0], at[None, ..., 1], mode="bilinear", align_corners=True)
        return np.ascontiguousarray(out[0].permute(1, 2, 0).numpy())


def undistortion(lens: Lens, size: tuple[int, int], target: tuple[int, int]) -> Undistortion:
    """The widest pinhole of ``target`` pixels, with the lens's principal point, that sees only what the lens saw.

    Arguments:
        size, target: (width, height) of the raw and of the pinhole pictures.

    Raises InputError when no pinhole up to three times the lens's focal length is covered (a wrong lens model).
    """
    scale = np.diag([target[0] / size[0], target[1] / size[1], 1.0])
    base = scale @ lens.K
    border = _border(*target)
    tried = [_rays(border, _zoomed(base, zoom)) for zoom in ZOOMS]
    places = lens_places(lens, size, np.concatenate(tried)).reshape(len(ZOOMS), -1, 2)
    inside = np.asarray(((places >= 0) & (places <= np.array(size))).all(axis=(1, 2)))
    # From the narrow end: a lens model may fold back far outside of the picture and look covered there.
    covered = np.flatnonzero(~inside[::-1])
    first = len(ZOOMS) - int(covered[0]) if len(covered) else 0
    if first == len(ZOOMS):
        raise InputError(
            f"undistortion: no pinhole is covered by a {lens.model} lens with {np.round(lens.params, 4).tolist()} and "
            f"pictures of {size[0]} x {size[1]}; expected a lens that sees straight ahead. Check the lens model"
        )
    K = _zoomed(base, ZOOMS[first])
    x, y = np.meshgrid(np.arange(target[0]) + 0.5, np.arange(target[1]) + 0.5)
    rays = _rays(np.stack([x.ravel(), y.ravel()], axis=1), K)
    return Undistortion(K, lens_places(lens, size, rays).reshape(target[1], target[0], 2))


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
        np.stack([x, np.zeros_like(x)], 1), np.stack([x, np.full_like(x, height)], 1),
        np.stack([np.zeros_like(y), y], 1), np.stack([np.full_like(y, width), y], 1),
    ]  # fmt: skip
    return np.concatenate(sides)
