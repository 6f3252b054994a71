"""Points that several cameras agree on where the scene lacks something: a small visual hull with colours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsstream.api import Cameras, FloatArray, IntArray

#: Depths tried along a ray; neighbours differ by about four percent of the range's logarithm.
DEPTHS = 48


@dataclass(frozen=True, slots=True)
class Hull:
    """P points, best first.

    Arguments:
        xyz: [P, 3] float32, scene units.
        rgb: [P, 3] float32 in [0, 1], mean of the views that see the point.
        size: [P] float32 side of one pixel at the nearest of these views, scene units.
    """

    xyz: FloatArray
    rgb: FloatArray
    size: FloatArray

    def __len__(self) -> int:
        return len(self.xyz)


def hull_points(
    images: FloatArray, masks: IntArray, cameras: Cameras, depths: tuple[float, float], *, rays: int,
    votes: float, least_views: int, agreement: float, generator: np.random.Generator,
) -> Hull:  # fmt: skip
    """Sample points on rays through marked pixels; keep those that land in marked pixels nearly wherever they project.

    Occlusion is not modelled: a point behind something else in more than 1 - ``votes`` of its views is not found.

    Arguments:
        images: [V, H, W, 3] in [0, 1].
        masks: [V, H, W] bool, pixels in which the scene lacks something.
        depths: nearest and farthest depth tried, scene units.
        rays: rays per view.
        votes: least share of the views a point projects into in which it lands in a marked pixel.
        least_views: least number of such views.
        agreement: largest standard deviation of any colour channel over these views, image units.
    """
    points = [_along_rays(masks[v], cameras, v, depths, rays, generator) for v in range(len(cameras))]
    xyz = np.concatenate(points) if points else np.zeros((0, 3))
    hits, seen = np.zeros(len(xyz)), np.zeros(len(xyz))
    total, squares = np.zeros((len(xyz), 3)), np.zeros((len(xyz), 3))
    size = np.full(len(xyz), np.inf)
    for view in range(len(cameras)):
        inside, rows, columns, depth = _project(xyz, cameras, view)
        marked = inside.copy()
        marked[inside] = masks[view][rows, columns]
        color = images[view][rows, columns][marked[inside]].astype(np.float64)
        seen += inside
        hits += marked
        total[marked] += color
        squares[marked] += color**2
        pixel = depth / cameras.Ks[view, 0, 0]
        size[marked] = np.minimum(size, np.where(marked, pixel, np.inf))[marked]
    count = np.maximum(hits, 1)[:, None]
    spread = np.sqrt(np.maximum(squares / count - (total / count) ** 2, 0.0)).max(1, initial=0.0)
    good = (hits >= least_views) & (hits >= votes * seen) & (spread <= agreement)
    order = np.flatnonzero(good)
    order = order[np.lexsort((spread[order], -hits[order]))]
    rgb = (total / count)[order]
    return Hull(xyz[order].astype(np.float32), rgb.astype(np.float32), size[order].astype(np.float32))


def one_per_cell(hull: Hull, cell: float, most: int) -> Hull:
    """The best point of each cell of a grid, at most ``most`` of them."""
    if not len(hull):
        return hull
    _, first = np.unique(np.floor(hull.xyz / cell).astype(np.int64), axis=0, return_index=True)
    rows = np.sort(first)[:most]
    return Hull(hull.xyz[rows], hull.rgb[rows], hull.size[rows])


def _along_rays(
    mask: IntArray, cameras: Cameras, view: int, depths: tuple[float, float], rays: int, generator: np.random.Generator
) -> FloatArray:
    """[rays * DEPTHS, 3] world points through marked pixels; fewer where fewer pixels are marked."""
    rows, columns = np.nonzero(mask)
    if len(rows) > rays:
        chosen = generator.choice(len(rows), rays, replace=False)
        rows, columns = rows[chosen], columns[chosen]
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], 1)
    directions = pixels @ np.linalg.inv(cameras.Ks[view]).T
    steps = (np.arange(DEPTHS) + generator.random((len(rows), DEPTHS))) / DEPTHS
    depth = depths[0] * (depths[1] / depths[0]) ** steps
    local = (directions[:, None] * depth[..., None]).reshape(-1, 3)
    pose = cameras.viewmats[view]
    points: FloatArray = (local - pose[:3, 3]) @ pose[:3, :3]
    return points


def _project(xyz: FloatArray, cameras: Cameras, view: int) -> tuple[IntArray, IntArray, IntArray, FloatArray]:
    """[P] bool who lands in the image, their rows and columns, and [P] depths."""
    pose, K = cameras.viewmats[view], cameras.Ks[view]
    local = xyz @ pose[:3, :3].T + pose[:3, 3]
    depth = local[:, 2]
    front = depth > cameras.near
    safe = np.where(front, depth, 1.0)
    u, v = K[0, 0] * local[:, 0] / safe + K[0, 2], K[1, 1] * local[:, 1] / safe + K[1, 2]
    inside = front & (u >= 0) & (v >= 0) & (u < cameras.width) & (v < cameras.height)
    return inside, v[inside].astype(np.int64), u[inside].astype(np.int64), depth
