"""Where newborn Gaussians are placed: where views that are wrong agree on a depth and a colour."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F

from gsstream.core.cameras import Cameras
from gsstream.core.context import FrameWork
from gsstream.core.projection import unproject
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.growth.judging import ErrorMap, landing

#: Pixels beside a pixel whose colours are compared, too: (row, column).
PATCH = ((0, 0), (-2, 0), (2, 0), (0, -2), (0, 2))
#: Part of the distances of the scene's Gaussians from a camera that is searched, widened by a factor at both ends.
SPREAD, WIDER = (0.02, 0.98), 1.25
#: What a depth farther by the whole range costs: of equals, the surface in front is the one that is seen.
BEHIND = 0.02
#: Share of the views that see a point which have to agree on it; the others may have something before it.
AGREEING = 0.5


class Placed(NamedTuple):
    """P points, worst error first: ``xyz`` [P, 3], ``rgb`` [P, 3] scene colours, ``pixel`` [P] size of one there."""

    xyz: FloatArray
    rgb: FloatArray
    pixel: FloatArray

    def __len__(self) -> int:
        return len(self.xyz)


def placed(
    work: FrameWork, maps: Mapping[int, ErrorMap], means: FloatArray, *, rays: int, depths: int, votes: float,
    agreement: float, generator: np.random.Generator,
) -> Placed:  # fmt: skip
    """Return points on rays through wrong pixels, at the depth at which the other views agree.

    Pictures are compared in the colours of the scene, so cameras of different colour response may be compared.

    Arguments:
        work: the frame.
        maps: of the views that propose, at least two.
        means: [N, 3] centres of the scene, which say how deep it is.
        rays: most rays per view.
        depths: depths tried along each.
        votes: least share of the views that a point lands in in which it must land in wrong pixels.
        agreement: largest difference of the colours around the point, in image units.
        generator: draws the rays.
    """
    stacks = {view: _patches(work.scene_image(view)) for view in maps}
    found, errors = [], []
    for view, one in maps.items():
        rows, columns = _worst(one, rays, generator)
        if not len(rows):
            continue
        grid = _along(work.cameras, view, rows, columns, _depths(means, work.cameras, view, depths))
        reference = stacks[view][0, :, rows, columns].T
        cost, support = _costs(work.cameras, maps, stacks, view, reference, grid, votes)
        cost = cost + BEHIND * np.arange(depths) / depths
        best = cost.argmin(1)
        ray = np.arange(len(rows))
        good = (cost[ray, best] <= agreement) & (support[ray, best] >= 2)
        xyz = grid.reshape(len(rows), depths, 3)[ray, best][good]
        depth = landing(xyz, work.cameras, view).depth
        found.append(Placed(xyz, reference[good, :3].numpy(), depth / work.cameras.Ks[view, 0, 0]))
        errors.append(one.error[rows, columns].numpy()[good])
    if not found:
        return Placed(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), np.zeros(0))
    order = np.argsort(-np.concatenate(errors), kind="stable")
    xyz, rgb, pixel = (np.concatenate([part[i] for part in found])[order] for i in range(3))
    return Placed(xyz.astype(np.float32), rgb.astype(np.float32), pixel)


def one_per_cell(found: Placed, pixels: float, most: int) -> Placed:
    """Return the first point of each cell of a grid, at most ``most`` of them.

    Arguments:
        found: worst error first.
        pixels: half the side of a cell, in pixels where the points are.
        most: of them.
    """
    if not len(found):
        return found
    cell = 2 * pixels * float(np.median(found.pixel))
    _, first = np.unique(np.floor(found.xyz.astype(np.float64) / cell).astype(np.int64), axis=0, return_index=True)
    rows = np.sort(first)[:most]
    return Placed(found.xyz[rows], found.rgb[rows], found.pixel[rows])


def _patches(image: torch.Tensor) -> torch.Tensor:
    """[1, 15, H, W] colours of the pixels of PATCH, means of 3 x 3, around each pixel."""
    smooth = F.avg_pool2d(image.permute(2, 0, 1)[None], 3, 1, 1, count_include_pad=False)
    reach = max(max(abs(row), abs(column)) for row, column in PATCH)
    padded = F.pad(smooth, (reach,) * 4, mode="replicate")
    height, width = image.shape[:2]
    return torch.cat([
        padded[..., reach + row : reach + row + height, reach + column : reach + column + width]
        for row, column in PATCH
    ], 1)  # fmt: skip


def _worst(one: ErrorMap, most: int, generator: np.random.Generator) -> tuple[IntArray, IntArray]:
    """Rows and columns of wrong pixels: all, or as many as may be, the more likely the worse."""
    rows, columns = (index.numpy() for index in one.wrong.nonzero(as_tuple=True))
    if len(rows) <= most:
        return rows, columns
    weight = one.error[rows, columns].numpy().astype(np.float64)
    chosen = np.sort(generator.choice(len(rows), most, replace=False, p=weight / weight.sum()))
    return rows[chosen], columns[chosen]


def _depths(means: FloatArray, cameras: Cameras, view: int, number: int) -> FloatArray:
    """[D] depths to try, near first, evenly spaced in inverse depth."""
    depth = landing(means, cameras, view)
    seen = depth.depth[depth.inside] if bool(depth.inside.any()) else np.ones(1)
    near, far = np.quantile(seen, SPREAD)
    return 1 / np.linspace(WIDER / max(near, cameras.near), 1 / (WIDER * far), number)


def _along(cameras: Cameras, view: int, rows: IntArray, columns: IntArray, depths: FloatArray) -> FloatArray:
    """[R * D, 3] points on the rays through pixels."""
    uv = np.stack([columns + 0.5, rows + 0.5], 1)
    return unproject(np.repeat(uv, len(depths), 0), np.tile(depths, len(uv)), cameras, view)


def _costs(
    cameras: Cameras, maps: Mapping[int, ErrorMap], stacks: Mapping[int, torch.Tensor], view: int,
    reference: torch.Tensor, grid: FloatArray, votes: float,
) -> tuple[FloatArray, IntArray]:  # fmt: skip
    """[R, D] mean difference of the colours around a point in the views that agree best, and how many are wrong there.

    Infinite where too few of the views that the point lands in are wrong there.
    """
    number = len(reference)
    differences = []
    seen, hit = np.zeros(len(grid), np.int64), np.zeros(len(grid), np.int64)
    for other in maps:
        if other == view:
            continue
        at = landing(grid, cameras, other)
        spots = np.stack([2 * at.column / cameras.width - 1, 2 * at.row / cameras.height - 1], 1)
        where = torch.from_numpy(spots.astype(np.float32))[None, None]
        sampled = F.grid_sample(stacks[other], where, align_corners=False, padding_mode="border")[0, :, 0]
        rows = np.clip(at.row, 0, cameras.height - 1).astype(np.int64)
        columns = np.clip(at.column, 0, cameras.width - 1).astype(np.int64)
        wrong = at.inside & maps[other].wrong.numpy()[rows, columns]
        off = (sampled.T.reshape(number, -1, sampled.shape[0]) - reference[:, None]).abs().mean(-1).numpy()
        differences.append(np.where(wrong.reshape(number, -1), off, np.inf))
        seen, hit = seen + at.inside, hit + wrong
    ranked = np.sort(np.stack(differences), 0)
    hits = np.reshape(hit, (number, -1))
    needed = np.maximum(2, np.ceil(AGREEING * hits)).astype(np.int64)
    total = np.cumsum(np.where(np.isfinite(ranked), ranked, 0), 0)
    place = np.minimum(needed, len(ranked)) - 1
    cost = np.take_along_axis(total, place[None], 0)[0] / (place + 1)
    enough = (hits >= 2) & (hits >= votes * np.reshape(seen, (number, -1)))
    return np.where(enough, cost, np.inf), hits
