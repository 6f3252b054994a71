"""The functions of ``tiles.py`` as kernels in Triton, one launch each."""

# Arguments of a kernel are what Triton makes of them: pointers and values of a program.
# mypy: disable-error-code="no-untyped-def, untyped-decorator"

from __future__ import annotations

import torch
import triton
import triton.language as tl

from gsstream_gsplat_render.tiles import TILE, index_type

#: Rows or entries of a program, and tiles of a box that are marked at once.
BLOCK, WIDE = 256, 32


@triton.jit(do_not_specialize=["count"])
def _find(means, radii, boxes, visible, count, rows, columns, side: tl.constexpr, block: tl.constexpr):
    """The box of ``block`` Gaussians, in tiles of ``side`` pixels."""
    row = tl.program_id(0) * block + tl.arange(0, block)
    there = row < count
    wide, high = tl.load(radii + 2 * row, mask=there, other=0), tl.load(radii + 2 * row + 1, mask=there, other=0)
    is_drawn = (wide > 0) & (high > 0)
    # What gsplat leaves in rows that are not drawn is not read.
    x = tl.load(means + 2 * row, mask=there & is_drawn, other=0.0) * (1.0 / side)
    y = tl.load(means + 2 * row + 1, mask=there & is_drawn, other=0.0) * (1.0 / side)
    across, down = wide.to(tl.float32) * (1.0 / side), high.to(tl.float32) * (1.0 / side)
    last_x, last_y = columns * 1.0, rows * 1.0
    left, top = tl.minimum(tl.maximum(tl.floor(x - across), 0.0), last_x), tl.maximum(tl.floor(y - down), 0.0)
    right, bottom = tl.minimum(tl.maximum(tl.ceil(x + across), 0.0), last_x), tl.maximum(tl.ceil(y + down), 0.0)
    top, bottom = tl.minimum(top, last_y), tl.minimum(bottom, last_y)
    tl.store(boxes + 4 * row, tl.where(is_drawn, left, 0.0).to(tl.int32), mask=there)
    tl.store(boxes + 4 * row + 1, tl.where(is_drawn, top, 0.0).to(tl.int32), mask=there)
    tl.store(boxes + 4 * row + 2, tl.where(is_drawn, right, 0.0).to(tl.int32), mask=there)
    tl.store(boxes + 4 * row + 3, tl.where(is_drawn, bottom, 0.0).to(tl.int32), mask=there)
    tl.store(visible + row, is_drawn.to(tl.uint8), mask=there)


@triton.jit(do_not_specialize=["count"])
def _count(boxes, near, areas, count, block: tl.constexpr):
    """Tiles of the boxes of ``block`` Gaussians, in the order ``near``."""
    place = tl.program_id(0) * block + tl.arange(0, block)
    there = place < count
    box = boxes + 4 * tl.load(near + place, mask=there, other=0)
    wide = tl.load(box + 2, mask=there, other=0) - tl.load(box, mask=there, other=0)
    high = tl.load(box + 3, mask=there, other=0) - tl.load(box + 1, mask=there, other=0)
    tl.store(areas + place, wide * high, mask=there)


@triton.jit(do_not_specialize=["count", "halvings", "size"])
def _list(boxes, near, ends, most, places, owners, count, halvings, columns, spare, size, block: tl.constexpr):
    """Tile and row of ``block`` entries."""
    slot = tl.program_id(0) * block + tl.arange(0, block)
    there = slot < size
    needed = tl.load(ends + count - 1)
    is_entry = there & (slot < tl.where(needed <= size, needed, 0))
    # The first row whose entries end behind this one.
    low, high = tl.zeros((block,), tl.int32), tl.zeros((block,), tl.int32) + count - 1
    for _ in range(halvings):
        middle = (low + high) // 2
        is_behind = tl.load(ends + middle, mask=is_entry, other=0) <= slot
        low, high = tl.where(is_behind, tl.minimum(middle + 1, high), low), tl.where(is_behind, high, middle)
    begin = tl.load(ends + low - 1, mask=is_entry & (low > 0), other=0).to(tl.int32)
    row = tl.load(near + low, mask=there, other=0)
    box = boxes + 4 * row
    left, top = tl.load(box, mask=is_entry, other=0), tl.load(box + 1, mask=is_entry, other=0)
    wide = tl.maximum(tl.load(box + 2, mask=is_entry, other=1) - left, 1)
    tile = (top + (slot - begin) // wide) * columns + left + (slot - begin) % wide
    tl.store(places + slot, tl.where(is_entry, tile, spare).to(places.dtype.element_ty), mask=there)
    tl.store(owners + slot, row.to(tl.int32), mask=there)
    if tl.program_id(0) == 0:
        tl.store(most, tl.maximum(tl.load(most), needed))


@triton.jit
def _cover(table, boxes, active, columns, wide: tl.constexpr):
    """Mark the tiles of one box; whoever marks a tile writes the same."""
    box = boxes + 4 * tl.load(active + tl.program_id(0))
    left, top = tl.load(box), tl.load(box + 1)
    across = tl.load(box + 2) - left
    area = across * (tl.load(box + 3) - top)
    for start in range(0, area, wide):
        place = start + tl.arange(0, wide)
        tile = (top + place // across) * columns + left + place % across
        tl.store(table + tile, tl.full((wide,), 1, tl.uint8), mask=place < area)


def find_boxes(
    means2d: torch.Tensor, radii: torch.Tensor, rows: int, columns: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return what ``tiles.find_boxes`` does."""
    count = len(radii)
    boxes = torch.empty(count, 4, dtype=torch.int32, device=radii.device)
    visible = torch.empty(count, dtype=torch.bool, device=radii.device)
    given = means2d.contiguous(), radii.contiguous(), boxes, visible.view(torch.uint8)
    _find[(triton.cdiv(count, BLOCK),)](*given, count, rows, columns, side=TILE, block=BLOCK)
    return boxes, visible


def count_entries(boxes: torch.Tensor, near: torch.Tensor) -> torch.Tensor:
    """Return what ``tiles.count_entries`` does."""
    areas = torch.empty(len(near), dtype=torch.int32, device=boxes.device)
    _count[(triton.cdiv(len(near), BLOCK),)](boxes, near, areas, len(near), block=BLOCK)
    return areas


def list_entries(
    boxes: torch.Tensor, near: torch.Tensor, ends: torch.Tensor, most: torch.Tensor, columns: int, spare: int, size: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return what ``tiles.list_entries`` does."""
    count = len(near)
    tile = torch.empty(size, dtype=index_type(spare), device=boxes.device)
    owner = torch.empty(size, dtype=torch.int32, device=boxes.device)
    given = boxes, near, ends, most, tile, owner
    numbers = count, count.bit_length(), columns, spare, size
    _list[(triton.cdiv(size, BLOCK),)](*given, *numbers, block=BLOCK)
    return tile, owner


def cover_tiles(table: torch.Tensor, boxes: torch.Tensor, rows: torch.Tensor) -> None:
    """Do what ``tiles.cover_tiles`` does."""
    if len(rows):
        _cover[(len(rows),)](table.view(torch.uint8), boxes, rows, table.shape[1], wide=WIDE)
