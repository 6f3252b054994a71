"""Which tiles of which views changed since the last frame, beyond the measured noise of their camera."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch

from gsstream.core.cameras import Cameras
from gsstream.core.frame import Frame
from gsstream.core.processors import processors
from gsstream.core.shapes import BoolArray, FloatArray, IntArray
from gsstream.core.storage import unpacked
from gsstream.engine.step.active.blocks import BLOCK, changed_blocks
from gsstream.parts.render.images import TILE

#: Blocks of a 16 x 16 tile (of 16) that must exceed the threshold.
MIN_BLOCKS = 2
#: Upper bound on the noise of one pixel of one image; see MOST_SIGMA of blocks.
MAX_PIXEL_SIGMA = 16 / 255
#: Number of pixels from which several views are compared at a time: with fewer, threads take longer than they save.
THREADED_PIXELS = 1 << 19


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

    @cached_property  # every iteration asks for it
    def dilated(self) -> torch.Tensor:
        """[V, ceil(H / 16), ceil(W / 16)] bool: tiles that changed, and those beside one that did."""
        return torch.nn.functional.max_pool2d(self.tiles[:, None].float(), 3, 1, 1)[:, 0] > 0

    def to(self, device: torch.device) -> Change:
        """Return the same tiles on a device."""
        return replace(self, tiles=self.tiles.to(device))

    def only_changed(self, view: int, values: torch.Tensor) -> torch.Tensor:
        """Return the values [H, W, 3] of this view's changed tiles, and 0 in the others."""
        if values.device.type != "cpu":
            grown = self.tiles[view].repeat_interleave(TILE, 0).repeat_interleave(TILE, 1)
            return values * grown[: self.height, : self.width, None]
        return self._in_changed(view, lambda region: values.numpy()[region])

    def difference(self, view: int, now: torch.Tensor, before: torch.Tensor) -> torch.Tensor:
        """Return ``now - before`` [H, W, 3] in this view's changed tiles, and 0 in the others.

        Arguments:
            now, before: [H, W, 3] float32, or uint8 of which 255 is 1.0 where the processor works.
        """
        if now.device.type != "cpu":
            return self.only_changed(view, now - before)
        return self._in_changed(view, lambda region: unpacked(now.numpy()[region]) - unpacked(before.numpy()[region]))

    def _in_changed(self, view: int, of: Callable[[tuple[slice, slice]], FloatArray]) -> torch.Tensor:
        """[H, W, 3] what ``of`` says of the changed regions of a view.

        Nine tenths of a picture stand still: where nothing is written, the memory is not even touched.
        """
        out = np.zeros((self.height, self.width, 3), np.float32)
        for region in _regions(self.tiles[view].numpy()):
            out[region] = of(region)
        return torch.from_numpy(out)

    def votes(self, means: torch.Tensor, cameras: Cameras) -> torch.Tensor:
        """Return [N]: share of the views a centre projects into in which its tile, or one beside it, has changed.

        Arguments:
            means: [N, 3] centres. A centre that projects into no view gets 0.
        """
        dilated = self.dilated.flatten(1).numpy()
        # What lies in no picture looks up a tile that never changes.
        lookup = np.concatenate([dilated, np.zeros((len(dilated), 1), np.bool_)], 1)
        hits, seen = np.zeros(len(means), np.int32), np.zeros(len(means), np.int32)
        centres = np.ascontiguousarray(means.numpy().T)
        for view in range(len(cameras)):
            inside, tile = self._tile_of(centres, cameras, view)
            seen += inside
            hits += lookup[view].take(np.where(inside, tile, len(lookup[view]) - 1))
        return torch.from_numpy(np.divide(hits, np.maximum(seen, 1), dtype=np.float32))

    def _tile_of(self, centres: FloatArray, cameras: Cameras, view: int) -> tuple[BoolArray, IntArray]:
        """[N] bool, which of the centres [3, N] project into a picture; [N] index of the tile, of any value elsewhere.

        Column by column: a row's answer has the same bits whatever other rows are asked about.
        """
        pose, K = cameras.viewmats[view].astype(np.float32), cameras.Ks[view].astype(np.float32)
        x, y, z = (row[0] * centres[0] + row[1] * centres[1] + row[2] * centres[2] + row[3] for row in pose[:3])
        inside: BoolArray = z > cameras.near_plane
        inverse = np.float32(1) / np.where(inside, z, np.float32(1))
        u, v = K[0, 0] * x * inverse + K[0, 2], K[1, 1] * y * inverse + K[1, 2]
        inside &= (u >= 0) & (v >= 0) & (u < self.width) & (v < self.height)
        # Numbers beyond the picture may not fit into an integer.
        u, v = (np.where(inside, of, np.float32(0)) * np.float32(1 / TILE) for of in (u, v))
        return inside, v.astype(np.int32) * np.int32(-(-self.width // TILE)) + u.astype(np.int32)


def _regions(tiles: BoolArray) -> Iterator[tuple[slice, slice]]:
    """Rows and columns of pixels of each run of marked tiles [rows, columns] bool that lie side by side."""
    padded = np.pad(tiles, ((0, 0), (1, 1)))
    rows, edges = np.nonzero(padded[:, 1:] != padded[:, :-1])  # a run begins and ends at an edge
    for row, first, last in zip(rows[::2].tolist(), edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        yield slice(row * TILE, (row + 1) * TILE), slice(first * TILE, last * TILE)


def detect_changed_tiles(previous: Frame, frame: Frame, threshold: float) -> Change | None:
    """Compare two frames view by view.

    Arguments:
        previous: the images that the scene shows.
        frame: the images of this frame.
        threshold: multiple of the robust spread of block differences; 0 switches the detection off (None).
    """
    if threshold == 0:
        return None

    def of(view: int) -> BoolArray:
        return _changed(changed_blocks(previous.images[view], frame.images[view], threshold))

    cameras, views = frame.cameras, range(len(frame.cameras))
    if cameras.width * cameras.height >= THREADED_PIXELS:
        with ThreadPoolExecutor(processors()) as pool:
            tiles = list(pool.map(of, views))
    else:
        tiles = [of(view) for view in views]
    return Change(torch.from_numpy(np.stack(tiles)), cameras.height, cameras.width)


def _changed(moved: BoolArray) -> BoolArray:
    """[rows, columns] bool of one view, of its blocks that changed."""
    count, blocks = count_per_tile(moved, TILE // BLOCK)
    return np.asarray(count >= np.minimum(MIN_BLOCKS, blocks))


def count_per_tile(marked: BoolArray, side: int = TILE) -> tuple[IntArray, IntArray]:
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
