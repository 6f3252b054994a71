"""What may change in a frame: cost follows change.

A tile has changed when enough of its pixels differ from the last frame beyond the camera's measured noise. A Gaussian
takes part when it is visible in a changed tile of some training view, its centre lies in or beside changed tiles in
enough of the views that it projects into, and its gate may open. Everything else is frozen: it is neither projected nor
optimised nor sent.

The vote is what keeps many cameras from making everything suspect: a wall is behind a moving person in some view, but
only what moves is in changed tiles in most of them (the idea of a visual hull).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from gsstream.core.cameras import Cameras
from gsstream.core.frame import Frame
from gsstream.core.shapes import FloatArray
from gsstream.metrics import noise_sigma
from gsstream.render.base import TILE

#: Pixels of a 16 x 16 tile that must exceed the threshold; beyond 4 sigma of normal noise five never meet by chance.
LEAST_PIXELS = 5
#: Noise of 8-bit images below rounding: half a level in each of two frames.
LEAST_SIGMA = 0.4 / 255


@dataclass(frozen=True)
class Change:
    """Changed tiles per view: ``tiles`` [V, ceil(H / 16), ceil(W / 16)] bool."""

    tiles: torch.Tensor
    height: int
    width: int

    @property
    def share(self) -> float:
        """Share of changed tiles over all views."""
        return float(self.tiles.float().mean()) if self.tiles.numel() else 0.0

    def pixels(self, view: int) -> torch.Tensor:
        """[H, W, 1] float mask of the pixels in changed tiles."""
        grown = self.tiles[view].repeat_interleave(TILE, 0).repeat_interleave(TILE, 1)
        return grown[: self.height, : self.width, None].float()

    def votes(self, means: torch.Tensor, cameras: Cameras) -> torch.Tensor:
        """[N] share of the views a centre projects into in which its tile, or one beside it, has changed.

        Arguments:
            means: [N, 3] centres. A centre that projects into no view gets 0.
        """
        near = torch.nn.functional.max_pool2d(self.tiles[:, None].float(), 3, 1, 1)[:, 0]
        hits, seen = torch.zeros(len(means)), torch.zeros(len(means))
        for view in range(len(cameras)):
            pose = torch.from_numpy(cameras.viewmats[view]).float()
            K = torch.from_numpy(cameras.Ks[view]).float()
            x, y, z = (means @ pose[:3, :3].T + pose[:3, 3]).unbind(1)
            inside = z > cameras.near
            depth = torch.where(inside, z, torch.ones_like(z))
            u, v = K[0, 0] * x / depth + K[0, 2], K[1, 1] * y / depth + K[1, 2]
            inside &= (u >= 0) & (v >= 0) & (u < self.width) & (v < self.height)
            row, column = (v[inside] / TILE).long(), (u[inside] / TILE).long()
            seen += inside
            hits[inside] += near[view, row, column]
        return hits / seen.clamp_min(1)


def detect_change(previous: Frame, frame: Frame, threshold: float) -> Change | None:
    """Compare two frames view by view.

    Arguments:
        threshold: multiple of the noise of a difference of two images; 0 switches the detection off (None).
    """
    if threshold == 0:
        return None
    tiles = [_changed(a, b, threshold) for a, b in zip(previous.images, frame.images, strict=True)]
    return Change(torch.from_numpy(np.stack(tiles)), frame.cameras.height, frame.cameras.width)


def _changed(before: FloatArray, after: FloatArray, threshold: float) -> np.ndarray:
    """[rows, columns] bool of one view."""
    # A quarter of the pixels gives the same robust estimate at a quarter of the cost.
    sigma = max(noise_sigma(before[::2, ::2], after[::2, ::2]), LEAST_SIGMA)
    moved = (np.abs(after - before) > threshold * np.sqrt(2) * sigma).any(-1)
    height, width = moved.shape
    rows, columns = -(-height // TILE), -(-width // TILE)
    padded = np.zeros((rows * TILE, columns * TILE), bool)
    padded[:height, :width] = moved
    counts = padded.reshape(rows, TILE, columns, TILE).sum((1, 3))
    # A clipped tile at the border has fewer pixels to show a change with.
    least = np.minimum(LEAST_PIXELS, np.outer(_sizes(height, rows), _sizes(width, columns)))
    return np.asarray(counts >= least)


def _sizes(length: int, tiles: int) -> np.ndarray:
    return np.minimum(TILE, length - TILE * np.arange(tiles))
