"""Which Gaussians each tile draws, in lists whose size is fixed beforehand.

gsplat's own function reads one number, how many entries there are, and the processor waits for it. Here nothing has a
size that depends on values: what is left of the lists belongs to one more row of tiles below the picture, whose mask is
False, so that no kernel looks at it. The lists are gsplat's, entry by entry: by tile, in a tile by depth, equal depths
by row.
"""

from __future__ import annotations

from typing import NamedTuple

import torch

from gsstream_gsplat_render.seen import Projected

#: Side of a tile, pixels.
TILE = 16
#: Tiles are counted in 16 bits where they fit, because sorting takes half of the time then.
SHORT = 1 << 15


class Grid:
    """What lists of one picture size need, made once on the device.

    Arguments:
        rows, columns: of tiles; partial tiles count.
        capacity: entries that the lists hold.
        device: where the lists are made.
    """

    def __init__(self, rows: int, columns: int, capacity: int, device: torch.device) -> None:
        self.rows, self.columns, self.capacity, self.number = rows, columns, capacity, rows * columns
        self.last = torch.tensor([float(columns), float(rows)]).to(device)
        #: Of the lower and the upper edge of a box, and of its four corners in a table of running sums.
        self.sign = torch.tensor([[-1.0], [1.0]]).to(device)
        self.parity = torch.tensor([[1, -1], [-1, 1]], dtype=torch.int32).to(device)
        self.slots = torch.arange(capacity, dtype=torch.int32).to(device)
        self.places = self.slots.long()
        self.bounds = torch.arange((rows + 1) * columns).to(torch.int16 if self.number < SHORT else torch.int32)
        self.bounds = self.bounds.to(device)
        #: Start, shift, width, gap of the entries that no Gaussian has: tile = slot + number - slot, whatever the slot.
        self.rest = torch.tensor([[0, self.number, 1, -1]], dtype=torch.int32).to(device)
        self.inside = torch.ones(rows + 1, columns, dtype=torch.bool)
        self.inside[rows] = False
        self.inside = self.inside.to(device)
        self.outside = torch.zeros(1, columns, dtype=torch.bool).to(device)
        #: [] the largest number of entries that was asked for; more than ``capacity``: a picture was left out.
        self.most = torch.zeros((), dtype=torch.int64).to(device)


class Lists(NamedTuple):
    """``order`` [capacity] int32 rows of Gaussians, ``offsets`` [rows + 1, columns] int32 where each tile begins.

    ``fits`` [] bool: nothing is missing.
    """

    order: torch.Tensor
    offsets: torch.Tensor
    fits: torch.Tensor


def boxes(seen: Projected, grid: Grid) -> torch.Tensor:
    """Return [N, 2, 2] int32: lower and upper (x, y), in tiles, of the box that each Gaussian is drawn in.

    Of rows that are not visible some box of the picture.
    """
    centre, half = seen.means2d.detach() / TILE, seen.radii / TILE
    # floor(c - h) = -ceil(h - c). A NaN, which gsplat may leave in rows that are not visible, becomes the corner.
    edges = torch.addcmul(half[:, None], centre[:, None], grid.sign).ceil_().mul_(grid.sign).clamp_min_(0)
    return torch.fmin(edges, grid.last).int()


def covered_tiles(edges: torch.Tensor, visible: torch.Tensor, grid: Grid) -> torch.Tensor:
    """Return [rows, columns] bool: the tiles under any of these boxes of visible rows.

    The corners of every box are added into a table, whose running sums then count the boxes over each tile.
    """
    places = torch.add(edges[:, None, :, 0], edges[:, :, 1, None], alpha=grid.columns + 1)
    marks = torch.zeros((grid.rows + 1) * (grid.columns + 1), dtype=torch.int32, device=edges.device)
    marks.index_add_(0, places.flatten(), (visible[:, None, None] * grid.parity).flatten())
    return marks.reshape(grid.rows + 1, -1).cumsum(0).cumsum(1)[: grid.rows, : grid.columns] > 0


def tile_lists(seen: Projected, edges: torch.Tensor, grid: Grid) -> Lists:
    """Sort the projected Gaussians of one view into tiles.

    Where the lists are too short, the farthest Gaussians are missing, ``fits`` is False, and ``grid.most`` says what
    would have been needed.
    """
    extent = edges[:, 1] - edges[:, 0]
    base = torch.add(edges[:, 0, 0], edges[:, 0, 1], alpha=grid.columns)
    # By depth first, whose bits have its order, and stably by tile afterwards.
    near = seen.depths.detach().view(torch.int32).sort(stable=True).indices
    count = extent[:, 0] * extent[:, 1] * seen.visible
    count, base, wide = torch.stack([count, base, extent[:, 0].clamp_min(1)], 1)[near].unbind(1)
    ends = count.cumsum(0)
    start = (ends - count).int()
    table = torch.cat([torch.stack([start, base - start, wide, grid.columns - wide], 1), grid.rest])
    # The row of every slot, then its tile: slot + (base - start) + (columns - wide) * (row of tiles in the box).
    owner = torch.searchsorted(ends, grid.places, right=True, out_int32=True)
    start, shift, wide, gap = table.index_select(0, owner).unbind(1)
    down = torch.div(grid.slots - start, wide, rounding_mode="trunc")
    tile = torch.addcmul(shift, down, gap) + grid.slots
    row = near.int().index_select(0, owner.clamp_max_(len(near) - 1))
    found, place = tile.to(grid.bounds.dtype).sort(stable=True)
    offsets = torch.searchsorted(found, grid.bounds, out_int32=True).reshape(grid.rows + 1, grid.columns)
    torch.maximum(grid.most, ends[-1], out=grid.most)
    return Lists(row[place], offsets, ends[-1] <= grid.capacity)
