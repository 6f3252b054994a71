"""Which Gaussians each tile draws, in lists whose size is fixed beforehand.

gsplat's own function reads one number, how many entries there are, and the processor waits for it. Here nothing has a
size that depends on values: what is left of the lists belongs to one more row of tiles below the picture, whose mask is
False, so that no kernel looks at it. The lists are gsplat's, entry by entry: by tile, in a tile by depth, equal depths
by row.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch

#: Side of a tile, pixels.
TILE = 16
#: Tiles are counted in 16 bits where they fit, because sorting takes half of the time then.
SHORT = 1 << 15


@dataclass(frozen=True, slots=True)
class TileKernels:
    """Functions of boxes, with the signatures of those in torch below."""

    find_boxes: Callable[..., Any]
    count_entries: Callable[..., Any]
    list_entries: Callable[..., Any]
    cover_tiles: Callable[..., Any]


def find_boxes(
    means2d: torch.Tensor, radii: torch.Tensor, rows: int, columns: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return [N, 4] int32, the box that each Gaussian is drawn in, and [N] bool, whether it is drawn at all.

    A box is its lower x and y and its upper x and y, in tiles; that of a Gaussian that is not drawn is empty.

    Arguments:
        means2d: [N, 2] pixels. radii: [N, 2] int32 pixels, above 0 where a Gaussian is drawn.
        rows, columns: of tiles.
    """
    visible = (radii > 0).all(-1)
    centre, half = means2d / TILE, radii / TILE
    edges = torch.cat([(centre - half).floor(), (centre + half).ceil()], 1).clamp_min(0)
    limited = [edges[:, k].clamp_max((columns, rows)[k % 2]) for k in range(4)]
    return torch.stack(limited, 1).where(visible[:, None], torch.zeros_like(edges)).int(), visible


def count_entries(boxes: torch.Tensor, near: torch.Tensor) -> torch.Tensor:
    """Return [N] int32: in how many tiles the Gaussians ``near`` [N], int64 and in their order, are drawn."""
    area: torch.Tensor = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    return area[near]


def list_entries(
    boxes: torch.Tensor, near: torch.Tensor, ends: torch.Tensor, most: torch.Tensor, columns: int, spare: int, size: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return tile and row of ``size`` entries, int16 (int32 where there are many tiles) and int32; by row.

    Where they are too few, all entries are in the tile ``spare``, which nobody looks at, and so are those left over.

    Arguments:
        boxes: [N, 4] of :func:`find_boxes`. near: [N] int64 rows from the nearest to the farthest.
        ends: [N] int64 running sum of :func:`count_entries`. most: [] int64, made as large as what is needed.
        columns: of tiles. spare: a tile beyond those of the picture.
    """
    slots = torch.arange(size, device=ends.device)
    owner = torch.searchsorted(ends, slots, right=True).clamp_max_(len(near) - 1)
    row = near[owner]
    left, top, right, bottom = boxes[row].unbind(1)
    wide = (right - left).clamp_min(1)
    place = slots - (ends[owner] - wide * (bottom - top))
    tile = (top + place // wide) * columns + left + place % wide
    tile = torch.where((slots < ends[-1]) & (ends[-1] <= size), tile, spare)
    torch.maximum(most, ends[-1], out=most)
    return tile.to(index_type(spare)), row.int()


def cover_tiles(table: torch.Tensor, boxes: torch.Tensor, rows: torch.Tensor) -> None:
    """Mark, in ``table`` [tile rows + 1, tile columns] bool, the tiles under the boxes [N, 4] of these rows [A].

    The corners of every box are added into a table, whose running sums then count the boxes over each tile.
    """
    left, top, right, bottom = boxes[rows].long().unbind(1)
    across = table.shape[1] + 1
    marks = torch.zeros(len(table) * across, dtype=torch.int32, device=table.device)
    begins, ends = [top * across + left, bottom * across + right], [top * across + right, bottom * across + left]
    one = torch.ones(2 * len(rows), dtype=torch.int32, device=table.device)
    marks.index_add_(0, torch.cat(begins), one).index_add_(0, torch.cat(ends), one, alpha=-1)
    table.logical_or_(marks.reshape(len(table), across).cumsum(0).cumsum(1)[:, :-1] > 0)


IN_TORCH = TileKernels(find_boxes, count_entries, list_entries, cover_tiles)


def index_type(spare: int) -> torch.dtype:
    """Return the type of the numbers of tiles up to ``spare``."""
    return torch.int16 if spare < SHORT else torch.int32


class Grid:
    """What lists of one picture size need, made once on the device.

    Arguments:
        rows, columns: of tiles; partial tiles count.
        capacity: entries that the lists hold.
        device: where the lists are made.
        kernels: what makes them.
    """

    def __init__(
        self, rows: int, columns: int, capacity: int, device: torch.device, kernels: TileKernels = IN_TORCH
    ) -> None:
        self.rows, self.columns, self.capacity, self.kernels = rows, columns, capacity, kernels
        #: The first tile below the picture.
        self.spare = rows * columns
        self.bounds = torch.arange((rows + 1) * columns).to(index_type(self.spare)).to(device)
        self.inside = torch.ones(rows + 1, columns, dtype=torch.bool)
        self.inside[rows] = False
        self.inside = self.inside.to(device)
        self.nothing = torch.zeros(rows + 1, columns, dtype=torch.bool).to(device)
        #: [] the largest number of entries that was asked for; more than ``capacity``: a picture was left out.
        self.most = torch.zeros((), dtype=torch.int64).to(device)

    def boxes(self, means2d: torch.Tensor, radii: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return what :func:`find_boxes` does."""
        boxes, visible = self.kernels.find_boxes(means2d.detach(), radii, self.rows, self.columns)
        return boxes, visible

    def covered(self, boxes: torch.Tensor, rows: torch.Tensor, before: torch.Tensor | None = None) -> torch.Tensor:
        """Return [tile rows + 1, tile columns] bool: the tiles of ``before`` and those under the boxes of these rows.

        In the last row of tiles, which is below the picture, there are none.
        """
        table = (self.nothing if before is None else before).clone()
        self.kernels.cover_tiles(table, boxes, rows)
        return table

    def padded(self, mask: torch.Tensor) -> torch.Tensor:
        """Return a mask [tile rows, tile columns] with a row more."""
        return torch.cat([mask, self.nothing[-1:]])


class Lists(NamedTuple):
    """``order`` [capacity] int32 rows of Gaussians, ``offsets`` [rows + 1, columns] int32 where each tile begins."""

    order: torch.Tensor
    offsets: torch.Tensor


def tile_lists(depths: torch.Tensor, boxes: torch.Tensor, grid: Grid) -> Lists:
    """Sort projected Gaussians into tiles, given their depths [N], above 0 where one is drawn, and their boxes [N, 4].

    Where the lists are too short, they are empty, and ``grid.most`` says what would have been needed.
    """
    # By depth first, whose bits have its order, and stably by tile afterwards.
    near = depths.detach().view(torch.int32).sort(stable=True).indices
    ends = grid.kernels.count_entries(boxes, near).cumsum(0)
    made = boxes, near, ends, grid.most
    tile, row = grid.kernels.list_entries(*made, grid.columns, grid.spare, grid.capacity)
    found, place = tile.sort(stable=True)
    offsets = torch.searchsorted(found, grid.bounds, out_int32=True).reshape(grid.rows + 1, grid.columns)
    return Lists(row[place], offsets)
