"""How well pictures agree on a surface on which they are drawn.

A search for a room asks hundreds of times, and a camera sees a tenth of a surface or less: all work on pixels happens
where a camera sees something. The tensors are too small for a second thread, and for a GPU.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from gsstream.core.cameras import Cameras
from gsstream.core.shapes import BoolArray, FloatArray
from gsstream.input.seeds.window import window_mean

#: Standard deviation of grey from which a window counts as texture; half the width of the windows that are compared;
#: and least number of places from which a score counts.
NOISE, HALF, ENOUGH = 0.02, 3, 500


@dataclass(frozen=True, slots=True)
class Surface:
    """A surface of one shape and any size and place, and pictures to draw on it.

    Arguments:
        grey: [C, H, W] pictures in [0, 1].
        cameras: C cameras of that size.
        turned: [3, C, R, S] homogeneous pixels of the shape, as if each camera stood in the origin.
    """

    grey: torch.Tensor
    cameras: Cameras
    turned: FloatArray

    @classmethod
    def shaped(cls, grey: torch.Tensor, cameras: Cameras, shape: FloatArray) -> Surface:
        """``shape``: [R, S, 3] places, neighbours beside each other."""
        rotation = (cameras.Ks @ cameras.viewmats[:, :3, :3]).transpose(1, 0, 2).reshape(-1, 3)
        turned = (rotation @ shape.reshape(-1, 3).T).reshape(3, len(cameras), *shape.shape[:2])
        return cls(grey, cameras, turned)

    def agreement(self, shift: FloatArray, scale: float = 1.0) -> float:
        """Return how well the pictures agree on the surface shift [3] + scale * shape: 0 to 1.

        It is the mean correlation, negative ones as 0, over all pairs of cameras and textured places; less where there
        are few of them.
        """
        places, seen = self._places(shift, scale)
        shades, means, variance = torch.zeros(3, *seen.shape)
        usable = torch.zeros(seen.shape, dtype=torch.bool)
        for view in np.flatnonzero(seen.any((1, 2))).tolist():
            part = (view, *_grown(seen[view]))
            x, y, depth = places[:, *part]
            near = depth.clip(min=self.cameras.near_plane)  # what lies behind has any colour, and is not seen
            shade = picture_at(self.grey[view], np.stack([x / near, y / near], -1))
            layers = torch.stack([shade, shade * shade, torch.from_numpy(seen[part]).float()])
            mean, square, whole = window_mean(layers[:, None], HALF)[:, 0]
            shades[part], means[part], variance[part] = shade, mean, (square - mean * mean).clamp_min(0)
            # A window counts where all of it lies in the picture.
            usable[part] = (whole > 0.99) & (variance[part] > NOISE**2)
        good, total = 0.0, 0
        for view in usable[:-1].flatten(1).any(1).nonzero()[:, 0].tolist():
            crop = _grown(usable[view].numpy())
            mine, rest = (view, *crop), (slice(view + 1, None), *crop)
            both = usable[mine] & usable[rest]
            cross = window_mean((shades[mine] * shades[rest])[:, None], HALF)[:, 0] - means[mine] * means[rest]
            same = cross / ((variance[mine] + NOISE**2) * (variance[rest] + NOISE**2)).sqrt()
            good += same[both].clamp_min(0).sum(dtype=torch.float64).item()
            total += int(both.sum())
        return good / total * min(1.0, total / ENOUGH) if total else 0.0

    def _places(self, shift: FloatArray, scale: float) -> tuple[FloatArray, BoolArray]:
        """Homogeneous pixels [3, C, R, S] of the surface, the third being depth, and who sees them [C, R, S]."""
        cameras = self.cameras
        moved = cameras.Ks @ (cameras.viewmats[:, :3, :3] @ shift + cameras.viewmats[:, :3, 3])[..., None]
        places = self.turned * scale
        places += moved.transpose(1, 0, 2)[..., None]
        x, y, depth = places
        seen = (depth > cameras.near_plane) & (x >= 0) & (y >= 0)
        seen &= (x < cameras.width * depth) & (y < cameras.height * depth)
        return places, seen


def picture_at(grey: torch.Tensor, uv: FloatArray) -> torch.Tensor:
    """Return what a picture [H, W] shows at pixels [R, S, 2] (pixel-corner origin), in between linearly: [R, S].

    Beyond its border it shows what the border does.
    """
    grid = (uv / grey.shape[::-1] * 2 - 1).astype(np.float32)[None]
    return F.grid_sample(grey[None, None], torch.from_numpy(grid), align_corners=False, padding_mode="border")[0, 0]


def _grown(marked: BoolArray) -> tuple[slice, slice]:
    """Rows and columns around all that is marked [R, S], and as many more as a window reaches."""
    sides = [np.flatnonzero(marked.any(axis)) for axis in (1, 0)]
    rows, columns = (slice(max(0, int(side[0]) - HALF), int(side[-1]) + HALF + 1) for side in sides)
    return rows, columns
