"""Seeds of frame 0: dense photo-consistent points, random fill where nothing is explained, thinning. Pure functions.

Only training cameras may be passed in; nothing here can tell them from test cameras.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.errors import InputError
from gsstream.core.frame import PointCloud
from gsstream.core.projection import inside, project, unproject
from gsstream.core.shapes import BoolArray, FloatArray, check_finite, check_shape
from gsstream.input.seeds.fusion import agreement, color_gains, interpolate_depths, world_points
from gsstream.input.seeds.geometry import depth_range, visible_views
from gsstream.input.seeds.sweep import SweepSettings, sweep_depths
from gsstream.input.seeds.thinning import cell_means, detail_cells, thin_points

__all__ = ["PhotoSeeds", "fill_volume", "photo_consistent_seeds", "thin_points", "visible_views"]


@dataclass(frozen=True, slots=True)
class PhotoSeeds:
    """Dense seeds and by-products of finding them.

    Arguments:
        points: P seeds; colours are freed of the cameras' relative gains.
        score: [P] float32 in [0, 1], share of the views that see the point's surface and confirm it.
        gains: [C, 3] float32 relative colour response per training camera (image = gain * common colour).
    """

    points: PointCloud
    score: FloatArray
    gains: FloatArray


def photo_consistent_seeds(
    images: FloatArray,
    cameras: Cameras,
    count: int,
    *,
    settings: SweepSettings | None = None,
    tolerance: float = 0.015,
    min_support: int = 2,
    dominance: float = 1.0,
) -> PhotoSeeds:
    """Find points that several views agree on: plane sweep, cross-view check, bridging of plain surfaces, thinning.

    Raises InputError for fewer than three cameras and when no two views agree anywhere.
    """
    check_shape("images", images, (len(cameras), cameras.height, cameras.width, 3))
    check_finite("images", images)
    if len(cameras) < 3 or count < 1:
        raise InputError(
            f"photo-consistent seeds: expected at least 3 training cameras and count >= 1, got {len(cameras)} cameras "
            f"and count {count}; give the recording points, or use structure from motion"
        )
    depths = sweep_depths(images, cameras, SweepSettings() if settings is None else settings)
    sure = agreement(depths, cameras, tolerance).accepted(min_support, dominance)
    if not sure.any():
        raise InputError(
            "photo-consistent seeds: no two views agree on any surface; check that the poses are world-to-camera with "
            "OpenCV axes, that frame 0 is synchronised, and that the images are undistorted"
        )
    gains = color_gains(images, depths, sure, cameras)
    depths = interpolate_depths(depths, sure)
    verdict = agreement(depths, cameras, tolerance)
    # The depth of an interpolated pixel was not matched, so twice as many views must support it.
    accepted = np.where(
        sure, verdict.accepted(min_support, dominance), verdict.accepted(min_support, 2 * dominance)
    )
    confidence = verdict.support / np.maximum(verdict.support + verdict.violation, 1)
    xyz = np.concatenate([world_points(depths, cameras, i)[accepted[i].reshape(-1)] for i in range(len(cameras))])
    common = np.clip(images / gains[:, None, None, :], 0, 1)
    cloud = PointCloud(xyz.astype(np.float32), common[accepted], f"plane sweep of {len(cameras)} training views")
    thinned, score = _thin_with_score(cloud, confidence[accepted].astype(np.float32), count)
    return PhotoSeeds(thinned, score, gains)


def _thin_with_score(cloud: PointCloud, score: FloatArray, count: int) -> tuple[PointCloud, FloatArray]:
    cells = detail_cells(cloud, count)
    xyz, rgb, mean_score = cell_means(cells, cloud.xyz, cloud.rgb, score[:, None])
    return PointCloud(xyz, rgb, cloud.origin), mean_score[:, 0]


def fill_volume(
    points: PointCloud | None,
    images: FloatArray,
    cameras: Cameras,
    count: int,
    *,
    min_views: int,
    min_distance: float,
    rng: np.random.Generator,
    cell: int = 4,
    attempts: int = 20,
) -> PointCloud:
    """Draw random seeds in the common view volume where the given points explain no pixels.

    A seed must be seen by ``min_views`` training cameras, keep ``min_distance`` from each of them, and fall on image
    cells without a point in most of the views that see it. Depth is uniform between the rig's near and far end.
    """
    check_shape("images", images, (len(cameras), cameras.height, cameras.width, 3))
    covered = _covered_cells(points, cameras, cell)
    near_far = depth_range(cameras)
    found: list[FloatArray] = []
    total = 0
    for _ in range(attempts):
        if total >= count:
            break
        candidates = _random_points(cameras, near_far, max(count, 1000), rng)
        visible = visible_views(candidates, cameras)
        gaps = np.linalg.norm(candidates[:, None] - cameras.centers[None], axis=2)
        keep = (visible.sum(1) >= min_views) & (gaps >= min_distance).all(1)
        keep &= _uncovered(candidates, visible, covered, cameras, cell)
        found.append(candidates[keep])
        total += int(keep.sum())
    xyz = np.concatenate(found)[:count] if found else np.zeros((0, 3))
    colors = _median_colors(xyz, images, cameras)
    return PointCloud(xyz.astype(np.float32), colors, f"random, seen by >= {min_views} views")


def _random_points(cameras: Cameras, near_far: FloatArray, count: int, rng: np.random.Generator) -> FloatArray:
    """Uniform over cameras, pixels and depths: every ray that needs explaining has the same chance."""
    view = rng.integers(len(cameras), size=count)
    uv = rng.random((count, 2)) * (cameras.width, cameras.height)
    depth = near_far[view, 0] + rng.random(count) * (near_far[view, 1] - near_far[view, 0])
    points = np.zeros((count, 3))
    for i in range(len(cameras)):
        mine = view == i
        points[mine] = unproject(uv[mine], depth[mine], cameras, i)
    return points


def _covered_cells(points: PointCloud | None, cameras: Cameras, cell: int) -> BoolArray:
    """[C, rows, columns]: image cells onto which a point projects."""
    rows, columns = -(-cameras.height // cell), -(-cameras.width // cell)
    covered = np.zeros((len(cameras), rows, columns), bool)
    if points is not None and len(points) > 0:
        for i in range(len(cameras)):
            uv, depth = project(points.xyz.astype(np.float64), cameras, i)
            column, row = (uv[inside(uv, depth, cameras)] // cell).astype(np.int64).T
            covered[i, row, column] = True
    return covered


def _uncovered(
    candidates: FloatArray, visible: BoolArray, covered: BoolArray, cameras: Cameras, cell: int
) -> BoolArray:
    """Candidates on uncovered cells in more than half of the views that see them."""
    explained = np.zeros(len(candidates))
    for i in range(len(cameras)):
        seen = np.flatnonzero(visible[:, i])
        column, row = (project(candidates[seen], cameras, i)[0] // cell).astype(np.int64).T
        explained[seen] += covered[i, row, column]
    uncovered: BoolArray = explained < 0.5 * visible.sum(1)
    return uncovered


def _median_colors(points: FloatArray, images: FloatArray, cameras: Cameras) -> FloatArray:
    """[P, 3] median colour over the views that see each point; every point must be seen by one."""
    samples = np.full((len(cameras), len(points), 3), np.nan, np.float32)
    for i in range(len(cameras)):
        uv, depth = project(points, cameras, i)
        seen = inside(uv, depth, cameras)
        column, row = uv[seen].astype(np.int64).T
        samples[i, seen] = images[i][row, column]
    if len(points) == 0:
        return np.zeros((0, 3), np.float32)
    colors: FloatArray = np.nanmedian(samples, axis=0)
    return colors
