"""What changed between two frames, in numpy: the tiles, rows and differences that ``gsstream.backend`` finds in torch.

Nine tenths of a picture stand still, and most rows are drawn where nothing changed: only the rest is looked at.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsstream.api import Cameras, FloatArray, IntArray
from gsstream.backend import Change, ChangeRule, RenderSession, changed_tiles, median
from gsstream_cpu_render.loss import TILE
from gsstream_cpu_render.threads import num_threads

BoolArray = NDArray[np.bool_]
#: Number of pixels from which several views are compared at a time: with fewer, threads take longer than they save.
THREADED_PIXELS = 1 << 19
#: Rows that are subtracted at a time, a multiple of the side of a block.
_BAND = 64


def find_change(before: Sequence[torch.Tensor], now: Sequence[torch.Tensor], threshold: float) -> CpuChange:
    """Return the changed tiles of every view; see ``gsstream.backend.Renderer.find_change``."""

    def of(pair: tuple[torch.Tensor, torch.Tensor]) -> BoolArray:
        return changed_blocks(pair[0].numpy(), pair[1].numpy(), threshold)

    height, width = now[0].shape[:2]
    pairs = zip(before, now, strict=True)
    if height * width >= THREADED_PIXELS:
        with ThreadPoolExecutor(num_threads()) as pool:
            blocks = list(pool.map(of, pairs))
    else:
        blocks = [of(pair) for pair in pairs]
    return CpuChange(changed_tiles(torch.from_numpy(np.stack(blocks))), height, width)


class _VoteCache:
    """The votes of a frame that were counted so far: a centre that has not moved since keeps its own."""

    def __init__(self) -> None:
        self._means, self._votes = np.zeros((0, 3), np.float32), np.zeros(0, np.float32)

    def of(
        self, means: torch.Tensor, rows: torch.Tensor, count: Callable[[torch.Tensor], torch.Tensor]
    ) -> torch.Tensor:
        """Return the votes [A] of these rows [A] of a scene with centres [N, 3]; ``count`` counts those not known."""
        centres, asked = means.numpy(), rows.numpy()
        if len(centres) != len(self._means):
            self._means = np.full_like(centres, np.nan)  # equal to no centre
            self._votes = np.zeros(len(centres), np.float32)
        now, before = centres[asked], self._means[asked]
        known = (now[:, 0] == before[:, 0]) & (now[:, 1] == before[:, 1]) & (now[:, 2] == before[:, 2])
        fresh = asked[~known]
        if len(fresh):
            self._means[fresh] = centres[fresh]
            self._votes[fresh] = count(torch.from_numpy(centres[fresh])).numpy()
        return torch.from_numpy(self._votes[asked])


@dataclass(frozen=True)
class CpuChange(Change):
    """Changed tiles, and the votes of a frame that were counted so far."""

    _known: _VoteCache = field(default_factory=_VoteCache, compare=False, repr=False)

    def only_changed(self, view: int, values: torch.Tensor) -> torch.Tensor:
        return self._in_changed(view, lambda region: values.numpy()[region])

    def difference(self, view: int, now: torch.Tensor, before: torch.Tensor) -> torch.Tensor:
        return self._in_changed(view, lambda region: floats(now.numpy()[region]) - floats(before.numpy()[region]))

    def _in_changed(self, view: int, of: Callable[[tuple[slice, slice]], FloatArray]) -> torch.Tensor:
        """[H, W, 3] what ``of`` says of the changed regions of a view.

        Nine tenths of a picture stand still: where nothing is written, the memory is not even touched.
        """
        out = np.zeros((self.height, self.width, 3), np.float32)
        for region in _regions(self.tiles[view].numpy()):
            out[region] = of(region)
        return torch.from_numpy(out)

    def votes(self, means: torch.Tensor, cameras: Cameras) -> torch.Tensor:
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

    def rows(self, means: torch.Tensor, cameras: Cameras, session: RenderSession, min_votes: float) -> torch.Tensor:
        if self.share == 0:
            return torch.zeros(len(means), dtype=torch.bool)
        seen = session.visible_anywhere(self.tiles)
        rows = seen.nonzero()[:, 0]
        seen[rows] = self._known.of(means, rows, lambda some: self.votes(some, cameras)) >= min_votes
        return seen


def _regions(tiles: BoolArray) -> Iterator[tuple[slice, slice]]:
    """Rows and columns of pixels of each run of marked tiles [rows, columns] bool that lie side by side."""
    padded = np.pad(tiles, ((0, 0), (1, 1)))
    rows, edges = np.nonzero(padded[:, 1:] != padded[:, :-1])  # a run begins and ends at an edge
    for row, first, last in zip(rows[::2].tolist(), edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        yield slice(row * TILE, (row + 1) * TILE), slice(first * TILE, last * TILE)


def changed_blocks(before: Any, now: Any, threshold: float) -> BoolArray:
    """Return [ceil(H / 4), ceil(W / 4)] bool: blocks whose mean difference exceeds the noise of block means.

    Arguments:
        before, now: [H, W, 3] float32, or uint8 of which 255 is 1.0.
        threshold: multiple of the noise.
    """
    means = difference_means(before, now)
    marked = np.abs(means) > threshold * block_sigma(means)
    return np.asarray(marked[..., 0] | marked[..., 1] | marked[..., 2])


def difference_means(before: Any, now: Any) -> FloatArray:
    """Return the block means of ``now - before``, band by band of rows: a whole difference would leave the cache."""
    bands = (slice(top, top + _BAND) for top in range(0, len(now), _BAND))
    return np.concatenate([block_means(_difference(before[band], now[band])) for band in bands])


def _difference(before: Any, now: Any) -> Any:
    """[H, W, 3] float32, or int16 in levels of 8 bits where both images are stored as bytes."""
    if before.dtype == now.dtype == np.uint8:
        return np.subtract(now, before, dtype=np.int16)
    return floats(now) - floats(before)


def floats(image: Any) -> FloatArray:
    """Return a stored image as float32, of which 255 of a byte is 1.0."""
    if image.dtype == np.uint8:
        return np.asarray(np.divide(image, np.float32(255), dtype=np.float32))
    return np.asarray(image, np.float32)


def _median_deviation(values: FloatArray) -> Any:
    difference = values - median(values)
    return median(np.abs(difference, out=difference))


def block_sigma(means: FloatArray) -> float:
    """Return the noise of block means of a difference, image units, within its bounds."""
    # Where most are this small no median has to be found: their deviation from it is at most twice as large.
    small = ChangeRule.LEAST_SIGMA / (2 * ChangeRule.MAD_TO_SIGMA) * (1 - 1e-9)
    if 2 * np.count_nonzero(np.abs(means) < small) > means.size:
        return ChangeRule.LEAST_SIGMA
    spread = ChangeRule.MAD_TO_SIGMA * float(_median_deviation(means))
    if spread <= ChangeRule.LEAST_SIGMA:  # then it does not matter what second differences admit
        return ChangeRule.LEAST_SIGMA
    return min(max(_at_most_rough(spread, means), ChangeRule.LEAST_SIGMA), ChangeRule.MOST_SIGMA)


def block_means(picture: Any) -> FloatArray:
    """Return [ceil(H / 4), ceil(W / 4), 3] means of [H, W, 3]; blocks at the border average the pixels they have.

    Sums of int16 are exact (they stay below 2^12), and a level is 1 / 255.
    """
    sums = _sums(_sums(picture).swapaxes(0, 1)).swapaxes(0, 1)
    if sums.dtype == np.int16:
        sums = np.divide(sums, 255.0)
    if not any(n % ChangeRule.BLOCK for n in picture.shape[:2]):
        return np.asarray(np.multiply(sums, 1 / ChangeRule.BLOCK**2, dtype=np.float64))
    sizes = [np.minimum(ChangeRule.BLOCK, n - np.arange(0, n, ChangeRule.BLOCK)) for n in picture.shape[:2]]
    return np.asarray(sums / np.outer(*sizes)[..., None])


def _sums(rows: Any) -> Any:
    """Sums over the rows of a block each; the last block may have fewer. A fifth of the time of ``np.add.reduceat``."""
    whole = len(rows) // ChangeRule.BLOCK * ChangeRule.BLOCK
    first, second, third, fourth = (rows[i : whole : ChangeRule.BLOCK] for i in range(ChangeRule.BLOCK))
    # The order in which reduceat adds, so that streams keep their bits.
    sums = first + (second + third + fourth)
    if whole == len(rows):
        return sums
    return np.concatenate([sums, rows[whole] + rows[whole + 1 :].sum(0, keepdims=True, dtype=rows.dtype)])


def _at_most_rough(spread: float, means: FloatArray) -> float:
    """The lesser of ``spread`` and of the noise that second differences of blocks along rows and columns admit."""
    rows, columns, channels = means.shape
    along, across = max(rows - 2, 0) * columns * channels, rows * max(columns - 2, 0) * channels
    if along + across == 0:  # a picture too small
        return spread
    values = np.empty(along + across, means.dtype)
    if along:
        _second_differences(means[:-2], means[1:-1], means[2:], values[:along].reshape(rows - 2, columns, channels))
    if across:
        out = values[along:].reshape(rows, columns - 2, channels)
        _second_differences(means[:, :-2], means[:, 1:-1], means[:, 2:], out)
    # The variance of a - 2 b + c is six times the variance of each term.
    admitted = ChangeRule.MOST_OF_ROUGHNESS * ChangeRule.MAD_TO_SIGMA / np.sqrt(6)
    # Usually the bound is above the spread, and counting alone shows that; the margin is for rounding.
    if np.count_nonzero(values < spread / admitted * (1 + 1e-9)) < len(values) // 2:
        return spread
    return min(spread, float(ChangeRule.MOST_OF_ROUGHNESS * ChangeRule.MAD_TO_SIGMA * median(values) / np.sqrt(6)))


def _second_differences(first: FloatArray, second: FloatArray, third: FloatArray, out: FloatArray) -> None:
    """Write |first - 2 second + third| to ``out``."""
    np.multiply(second, 2, out=out)
    np.subtract(first, out, out=out)
    np.add(out, third, out=out)
    np.abs(out, out=out)
