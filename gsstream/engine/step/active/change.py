"""Which tiles of which views changed since the last frame, beyond the measured noise of their camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from gsstream.core.cameras import Cameras
from gsstream.core.frame import Frame
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.core.storage import unpacked
from gsstream.metrics.noise import MAD_TO_SIGMA, median_deviation
from gsstream.render.base import TILE

BoolArray = np.ndarray[Any, np.dtype[np.bool_]]
#: Differences are averaged over BLOCK x BLOCK pixels first: noise of neighbouring pixels is mostly independent and
#: averages out (rendered noise is heavy-tailed, so a threshold on single pixels finds it everywhere), motion does not.
BLOCK = 4
#: Blocks of a 16 x 16 tile (of 16) that must exceed the threshold.
LEAST_BLOCKS = 2
#: Lower bound on the estimated noise of a block's mean difference. Compressed video repeats still blocks exactly;
#: without a floor the change of half a grey level by the encoder would count as motion.
LEAST_SIGMA = 0.5 / 255
#: Upper bound on the same estimate. The estimate holds while fewer than half of the blocks
#: move; a flash or a cut moves all of them, and then the change itself would pass for noise and nothing would be seen
#: to change. Recordings have about 1 / 255.
MOST_SIGMA = 4 / 255
#: Upper bound on the same estimate, in multiples of the differences between neighbouring blocks. Noise differs from
#: block to block, a slow change of the light hardly does: at a gain of 1.03 the spread of the differences doubles,
#: their second differences grow by 5 %. Without such a change the first is at most 1.2 times the second on the
#: recordings at hand.
MOST_OF_ROUGHNESS = 1.5
#: The same for the noise of one pixel of one image.
MOST_PIXEL_SIGMA = 16 / 255


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
        """Return [H, W, 1]: 1.0 where a pixel of this view lies in a changed tile, else 0.0."""
        grown = self.tiles[view].repeat_interleave(TILE, 0).repeat_interleave(TILE, 1)
        return grown[: self.height, : self.width, None].float()

    def votes(self, means: torch.Tensor, cameras: Cameras) -> torch.Tensor:
        """Return [N]: share of the views a centre projects into in which its tile, or one beside it, has changed.

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
        previous: the images that the scene shows.
        frame: the images of this frame.
        threshold: multiple of the robust spread of block differences; 0 switches the detection off (None).
    """
    if threshold == 0:
        return None
    tiles = [_changed(unpacked(a), b, threshold) for a, b in zip(previous.images, frame.images, strict=True)]
    return Change(torch.from_numpy(np.stack(tiles)), frame.cameras.height, frame.cameras.width)


def _changed(before: FloatArray, after: FloatArray, threshold: float) -> BoolArray:
    """[rows, columns] bool of one view."""
    means = _block_means(after - before)
    sigma = min(max(min(MAD_TO_SIGMA * float(median_deviation(means)), _rough(means)), LEAST_SIGMA), MOST_SIGMA)
    moved: BoolArray = np.asarray((np.abs(means) > threshold * sigma).any(-1))
    count, blocks = marked_per_tile(moved, TILE // BLOCK)
    return np.asarray(count >= np.minimum(LEAST_BLOCKS, blocks))


def marked_per_tile(marked: BoolArray, side: int = TILE) -> tuple[IntArray, IntArray]:
    """Count what is marked in each tile: ([rows, columns] how many are, and how many there are).

    A tile cut off by the border has fewer to show a change with.

    Arguments:
        marked: [H, W] bool, pixels or blocks of them. side: of a tile, in these.
    """
    rows, columns = -(-marked.shape[0] // side), -(-marked.shape[1] // side)
    padded = np.zeros((rows * side, columns * side), bool)
    padded[: marked.shape[0], : marked.shape[1]] = marked
    inside = np.zeros_like(padded)
    inside[: marked.shape[0], : marked.shape[1]] = True
    count, number = (x.reshape(rows, side, columns, side).sum((1, 3)) for x in (padded, inside))
    return count, number


def _rough(means: FloatArray) -> float:
    """Most noise of a block that its second differences along rows and columns admit; inf in a picture too small."""
    second = [means[:-2] - 2 * means[1:-1] + means[2:], means[:, :-2] - 2 * means[:, 1:-1] + means[:, 2:]]
    values = np.abs(np.concatenate([part.ravel() for part in second]))
    if not values.size:
        return np.inf
    # The variance of a - 2 b + c is six times that of each.
    return float(MOST_OF_ROUGHNESS * MAD_TO_SIGMA * np.median(values) / np.sqrt(6))


def _block_means(difference: FloatArray) -> FloatArray:
    """[ceil(H / 4), ceil(W / 4), 3] means; blocks at the border average the pixels they have."""
    height, width = difference.shape[:2]
    starts = np.arange(0, height, BLOCK), np.arange(0, width, BLOCK)
    sums = np.add.reduceat(np.add.reduceat(difference, starts[0], 0), starts[1], 1)
    sizes = [np.minimum(BLOCK, n - s) for n, s in zip((height, width), starts, strict=True)]
    return np.asarray(sums / np.outer(*sizes)[..., None])
