"""A picture drawn part by part, where its Gaussians cover more tiles than may lie in memory at a time.

The tiles of a picture do not know of each other, so that the parts have the bits of the whole.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gsstream_cpu_render.arrays import TOO_MANY_PAIRS, Float32, SplatArrays, mask_shape
from gsstream_cpu_render.native import PAIR_BYTES, SPLAT_BYTES

if TYPE_CHECKING:
    from gsstream_cpu_render.rasterizer import NumpyRasterizer

#: Bytes of one part, beside those of the Gaussians themselves: enough for the whole of an ordinary picture.
PART = 160_000_000
#: A rectangle of tiles: first and last row, first and last column.
Tiles = tuple[int, int, int, int]


def draw_by_parts(view: NumpyRasterizer, splats: SplatArrays, most: int, part: int = PART) -> Float32:
    """Return the picture [H, W, 3] of ``view.forward(splats)``, bit for bit, of parts that take ``part`` bytes at most.

    Raises MemoryError when all parts together, which are a measure of the work, would take more than ``most`` bytes;
    at once where they would take far more. Small parts count a little more than the same tiles of the whole do.
    """
    shape, rows = mask_shape(view.width, view.height), len(splats.means)
    left = most - SPLAT_BYTES * rows
    view.limit_memory(min(part, left) + SPLAT_BYTES * rows, rows)
    try:
        return view.forward(splats)[0]
    except MemoryError:
        expected = _expected(view, splats, shape, part)
        if left <= part or expected > 2 * left:
            raise
    image, transmittance = view.forward(splats, tile_mask=np.zeros(shape, bool))  # the background
    waiting: list[Tiles] = [(0, shape[0], 0, shape[1])]
    while waiting:
        tiles = waiting.pop()
        mask = np.zeros(shape, bool)
        mask[tiles[0] : tiles[1], tiles[2] : tiles[3]] = True
        single = mask.sum() == 1
        if single or mask.mean() * expected <= part:
            try:
                view.forward(splats, tile_mask=mask, image=image, transmittance=transmittance)
            except MemoryError:
                if single:
                    raise
            else:
                left -= PAIR_BYTES * view.statistics()["pairs"]
                if left < 0:
                    raise MemoryError(TOO_MANY_PAIRS)
                continue
        waiting += _halves(tiles)
    return image


def _expected(view: NumpyRasterizer, splats: SplatArrays, shape: tuple[int, int], part: int) -> float:
    """Bytes of the whole picture by those of every sixteenth tile across and down; they are at least these many."""
    sample = np.zeros(shape, bool)
    sample[::16, ::16] = True
    try:
        view.forward(splats, tile_mask=sample)
    except MemoryError:
        return float(part / sample.mean())
    return float(PAIR_BYTES * view.statistics()["pairs"] / sample.mean())


def _halves(tiles: Tiles) -> list[Tiles]:
    """Two rectangles, cut across the longer side."""
    top, bottom, left, right = tiles
    if bottom - top >= right - left:
        middle = (top + bottom) // 2
        return [(top, middle, left, right), (middle, bottom, left, right)]
    middle = (left + right) // 2
    return [(top, bottom, left, middle), (top, bottom, middle, right)]
