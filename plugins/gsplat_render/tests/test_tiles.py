"""Lists of tiles of fixed size against gsplat's own formulas, entry by entry, on random and on degenerate scenes."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass

import pytest
import torch
from gsplat.cuda._torch_impl import _isect_offset_encode, _isect_tiles
from gsstream_gsplat_render.fused import load_fused
from gsstream_gsplat_render.tiles import IN_TORCH, TILE, Grid, TileKernels, tile_lists

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
#: Those of torch, and those in Triton, on a GPU where there is one, else in Triton's interpreter.
DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
FUSED = load_fused(DEVICE.type) if importlib.util.find_spec("triton") else None
KERNELS = ["torch", "triton"] if importlib.util.find_spec("triton") else ["torch"]


@pytest.fixture(params=KERNELS)
def kernels(request: pytest.FixtureRequest) -> TileKernels:
    if request.param == "torch":
        return IN_TORCH
    assert FUSED is not None, "Triton is here and its kernels are not used: the warning of load_fused says why"
    return FUSED.tiles


@dataclass(frozen=True)
class Case:
    means2d: torch.Tensor
    radii: torch.Tensor
    depths: torch.Tensor
    rows: int
    columns: int

    @property
    def visible(self) -> torch.Tensor:
        return (self.radii > 0).all(-1)

    def boxes(self, grid: Grid) -> torch.Tensor:
        found, visible = grid.boxes(self.means2d.to(DEVICE), self.radii.to(DEVICE))
        assert torch.equal(visible.cpu(), self.visible)
        return found


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
    return Case(means, radii, depths, -(-height // TILE), -(-width // TILE))


def expected(case: Case) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Tile of each entry, rows, and where tiles begin; sorted stably, as the kernel sorts."""
    visible, nothing = case.visible, torch.zeros(())
    means, depths = case.means2d.where(visible[:, None], nothing), case.depths.where(visible, nothing + 1)
    _, keys, order = _isect_tiles(
        means[None], case.radii[None], depths[None], TILE, case.columns, case.rows, sort=False
    )
    keys, place = keys.sort(stable=True)
    return keys >> 32, order[place], _isect_offset_encode(keys, 1, case.columns, case.rows)[0]


@pytest.mark.parametrize("kind", KINDS)
def test_lists_are_those_of_gsplat(kind: str, kernels: TileKernels) -> None:
    for seed in range(6 if kernels is IN_TORCH or DEVICE.type == "cuda" else 1):  # the interpreter is slow
        compare(case(kind, seed), kernels)


def compare(given: Case, kernels: TileKernels) -> None:
    _, order, offsets = expected(given)
    number = len(order)
    for capacity in (number + 37, max(1, number)):
        grid = Grid(given.rows, given.columns, capacity, DEVICE, kernels)
        found = tile_lists(given.depths.to(DEVICE), given.boxes(grid), grid)
        assert int(grid.most) == number
        assert torch.equal(found.order[:number].cpu(), order)
        assert torch.equal(found.offsets[: given.rows].cpu(), offsets)
        # What is left belongs to the row of tiles below the picture, and names rows that exist.
        assert int(found.offsets[given.rows, 0]) == number
        assert int(found.order.min()) >= 0
        assert int(found.order.max()) < len(given.depths)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in ("empty", "off-screen")])
def test_a_list_that_is_too_short_says_so_and_is_empty(kind: str, kernels: TileKernels) -> None:
    given = case(kind, 1)
    number = len(expected(given)[1])
    assert number > 1
    grid = Grid(given.rows, given.columns, number // 2, DEVICE, kernels)
    found = tile_lists(given.depths.to(DEVICE), given.boxes(grid), grid)
    assert int(grid.most) == number
    assert not found.offsets[: given.rows].any()
    assert not found.offsets[given.rows, 0]
    assert 0 <= int(found.order.min()) <= int(found.order.max()) < len(given.depths)


@pytest.mark.parametrize("kind", KINDS)
def test_tiles_that_rows_cover_are_those_of_their_entries(kind: str, kernels: TileKernels) -> None:
    given = case(kind, 2)
    tile, order, _ = expected(given)
    active = torch.rand(len(given.depths), generator=torch.Generator().manual_seed(3)) < 0.1
    hits = torch.zeros(given.rows * given.columns).index_add_(0, tile, active[order.long()].float())
    grid = Grid(given.rows, given.columns, 1, DEVICE, kernels)
    rows, boxes = active.nonzero()[:, 0].to(DEVICE), given.boxes(grid)
    found = grid.covered(boxes, rows)
    assert torch.equal(found[: given.rows].cpu(), hits.reshape(given.rows, given.columns) > 0)
    before = torch.zeros_like(found)
    before[0, -1] = True
    assert torch.equal(grid.covered(boxes, rows, before), found | before)
    assert not found[given.rows].any()


def test_many_tiles_are_counted_in_32_bits(kernels: TileKernels) -> None:
    grid = Grid(300, 200, 64, DEVICE, kernels)
    assert grid.bounds.dtype == torch.int32
    means, radii = torch.tensor([[3190.0, 4790.0], [8.0, 8.0]]), torch.full((2, 2), 4, dtype=torch.int32)
    found = tile_lists(torch.tensor([1.0, 2.0]).to(DEVICE), grid.boxes(means.to(DEVICE), radii.to(DEVICE))[0], grid)
    assert found.order[:2].tolist() == [1, 0]
    assert found.offsets[0, :2].tolist() == [0, 1]
    assert int(found.offsets[299, 199]) == 1
