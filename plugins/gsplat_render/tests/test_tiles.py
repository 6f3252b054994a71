"""Lists of tiles of fixed size against gsplat's own formulas, entry by entry, on random and on degenerate scenes."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from gsplat.cuda._torch_impl import _isect_offset_encode, _isect_tiles
from gsstream_gsplat_render.seen import Projected
from gsstream_gsplat_render.tiles import TILE, Grid, boxes, covered_tiles, tile_lists

KINDS = (
    "ordinary",
    "empty",
    "huge",
    "off-screen",
    "equal depths",
    "one row",
    "on the borders",
    "sliver",
    "undefined",
    "mixed",
)
CPU = torch.device("cpu")


@dataclass(frozen=True)
class Case:
    seen: Projected
    rows: int
    columns: int


def case(kind: str, seed: int) -> Case:
    g = torch.Generator().manual_seed(seed)
    width, height = (int(torch.randint(1, 200, (), generator=g)) for _ in range(2))
    number = {"one row": 1, "huge": 40}.get(kind, 200)
    means = (torch.rand(number, 2, generator=g) * 1.4 - 0.2 + 3 * (kind == "off-screen")) * torch.tensor(
        [float(width), float(height)]
    )
    radii = torch.randint(1, 40, (number, 2), generator=g, dtype=torch.int32)
    depths = torch.rand(number, generator=g) * 10 + 0.01
    hidden = torch.rand(number, generator=g) < (2 if kind == "empty" else 0.3)
    if kind == "huge":
        radii *= torch.tensor([5000, 700], dtype=torch.int32)
        means[::3] *= 1e7
    if kind in ("equal depths", "mixed"):
        depths = (depths * 0.3).floor() + 1
    if kind == "on the borders":
        means, radii = (means / TILE).round() * TILE, (radii / TILE).round().int().clamp_min(1) * TILE
    if kind == "sliver":
        radii[:, 0] = 1
    radii[hidden] = 0
    if kind in ("undefined", "mixed"):  # what gsplat leaves in rows that are not visible
        means[hidden], depths[hidden] = torch.tensor([float("nan"), float("-inf")]), float("nan")
    rest = torch.zeros(number, 3), torch.zeros(number, 3), torch.zeros(number)
    seen = Projected((radii > 0).all(-1), means, depths, *rest, radii)
    return Case(seen, -(-height // TILE), -(-width // TILE))


def expected(case: Case) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Tile of each entry, rows, and where tiles begin; sorted stably, as the kernel sorts."""
    seen, nothing = case.seen, torch.zeros(())
    means, depths = seen.means2d.where(seen.visible[:, None], nothing), seen.depths.where(seen.visible, nothing + 1)
    _, keys, order = _isect_tiles(
        means[None], seen.radii[None], depths[None], TILE, case.columns, case.rows, sort=False
    )
    keys, place = keys.sort(stable=True)
    return keys >> 32, order[place], _isect_offset_encode(keys, 1, case.columns, case.rows)[0]


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("kind", KINDS)
def test_lists_are_those_of_gsplat(kind: str, seed: int) -> None:
    given = case(kind, seed)
    _, order, offsets = expected(given)
    number = len(order)
    for capacity in (number + 37, max(1, number)):
        grid = Grid(given.rows, given.columns, capacity, CPU)
        found = tile_lists(given.seen, boxes(given.seen, grid), grid)
        assert bool(found.fits)
        assert int(grid.most) == number
        assert torch.equal(found.order[:number], order)
        assert torch.equal(found.offsets[: given.rows], offsets)
        # What is left belongs to the row of tiles below the picture, and names rows that exist.
        assert int(found.offsets[given.rows, 0]) == number
        assert int(found.order.min()) >= 0
        assert int(found.order.max()) < len(given.seen.depths)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in ("empty", "off-screen")])
def test_a_list_that_is_too_short_says_so(kind: str) -> None:
    given = case(kind, 1)
    number = len(expected(given)[1])
    assert number > 1
    grid = Grid(given.rows, given.columns, number // 2, CPU)
    found = tile_lists(given.seen, boxes(given.seen, grid), grid)
    assert not bool(found.fits)
    assert int(grid.most) == number
    assert 0 <= int(found.order.min()) <= int(found.order.max()) < len(given.seen.depths)


@pytest.mark.parametrize("kind", KINDS)
def test_tiles_that_rows_cover_are_those_of_their_entries(kind: str) -> None:
    given = case(kind, 2)
    tile, order, _ = expected(given)
    active = torch.rand(len(given.seen.depths), generator=torch.Generator().manual_seed(3)) < 0.1
    hits = torch.zeros(given.rows * given.columns).index_add_(0, tile, active[order.long()].float())
    grid = Grid(given.rows, given.columns, 1, CPU)
    rows = active.nonzero()[:, 0]
    found = covered_tiles(boxes(given.seen, grid)[rows], given.seen.visible[rows], grid)
    assert torch.equal(found, hits.reshape(given.rows, given.columns) > 0)


def test_many_tiles_are_counted_in_32_bits() -> None:
    grid = Grid(300, 200, 64, CPU)
    assert grid.bounds.dtype == torch.int32
    means, radii = torch.tensor([[3190.0, 4790.0], [8.0, 8.0]]), torch.full((2, 2), 4, dtype=torch.int32)
    rest = torch.zeros(2, 3), torch.zeros(2, 3), torch.zeros(2)
    seen = Projected(torch.ones(2, dtype=torch.bool), means, torch.tensor([1.0, 2.0]), *rest, radii)
    found = tile_lists(seen, boxes(seen, grid), grid)
    assert found.order[:2].tolist() == [1, 0]
    assert found.offsets[0, :2].tolist() == [0, 1]
    assert int(found.offsets[299, 199]) == 1
