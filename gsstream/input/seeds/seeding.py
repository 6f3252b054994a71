"""Seeds of frame 0: dense photo-consistent points. Pure functions.

Only training cameras may be passed in; nothing here can tell them from test cameras.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.errors import InputError
from gsstream.core.frame import PointCloud
from gsstream.core.progress import Tell, silent
from gsstream.core.shapes import BoolArray, FloatArray, check_finite, check_shape
from gsstream.input.seeds.fusion import agreement, color_gains, interpolate_depths, world_points
from gsstream.input.seeds.room import stands_around, with_room
from gsstream.input.seeds.sweep import SweepSettings, sweep_depths
from gsstream.input.seeds.thinning import cell_means, detail_cells


@dataclass(frozen=True, slots=True)
class PhotoSeeds:
    """Dense seeds and by-products of finding them.

    Arguments:
        points: P seeds; colours are freed of the cameras' relative gains.
        score: [P] float32 in [0, 1], share of the views that see the point's surface and confirm it; less where points
            of the walls of a room, which none confirms, were thinned into it.
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
    known: FloatArray | None = None,
    settings: SweepSettings | None = None,
    tolerance: float = 0.015,
    min_support: int = 2,
    dominance: float = 1.0,
    tell: Tell = silent,
) -> PhotoSeeds:
    """Find points that several views agree on: plane sweep, cross-view check, bridging of plain surfaces, thinning.

    A rig that looks inwards from around stands in a room; where the sweep is not sure, points lie on its walls.

    Arguments:
        known: [C, H, W] planar depth of the recording's depth maps, NaN where nothing is known: known depths take
            precedence over found ones, and where every camera has a map no depth is searched for.

    Raises InputError for fewer than three cameras, unless all have a depth map, and when no two views agree anywhere.
    """
    check_shape("images", images, (len(cameras), cameras.height, cameras.width, 3))
    check_finite("images", images)
    settings = settings or SweepSettings()
    known = np.full(images.shape[:3], np.nan, np.float32) if known is None else known
    given = np.isfinite(known)
    maps = int(given.any((1, 2)).sum())
    if (len(cameras) < 3 and maps < len(cameras)) or count < 1:
        raise InputError(
            f"photo-consistent seeds: expected at least 3 training cameras and count >= 1, got {len(cameras)} cameras "
            f"and count {count}; give the recording points, or use structure from motion"
        )
    if maps == len(cameras):
        swept, sure, origin = interpolate_depths(known, given), given, f"depth maps of {maps} cameras"
    else:
        swept = sweep_depths(images, cameras, settings, tell)
        swept = np.where(given, known, swept)
        tell("looking for points: comparing what the cameras found", 0, 0)
        sure = given | agreement(swept, cameras, tolerance).accepted(min_support, dominance)
        _check_agreement(sure)
        origin = f"plane sweep of {len(cameras)} training views" + f", depth maps of {maps}" * bool(maps)
    gains = color_gains(images, swept, sure, cameras)
    depths = interpolate_depths(swept, sure)
    verdict = agreement(depths, cameras, tolerance)
    # The depth of an interpolated pixel was not matched, so twice as many views must support it.
    accepted = np.where(sure, verdict.accepted(min_support, dominance), verdict.accepted(min_support, 2 * dominance))
    confidence = verdict.support / np.maximum(verdict.support + verdict.violation, 1) * accepted
    accepted |= given
    if stands_around(cameras):
        origin += " and the room that they stand in"
        depths, accepted = with_room(images, cameras, swept, depths=depths, accepted=accepted, given=given, tell=tell)
    xyz = np.concatenate([world_points(depths, cameras, i)[accepted[i].reshape(-1)] for i in range(len(cameras))])
    common = np.clip(images / gains[:, None, None, :], 0, 1)
    cloud = PointCloud(xyz.astype(np.float32), common[accepted], origin)
    thinned, score = _thin_with_score(cloud, confidence[accepted].astype(np.float32), count)
    return PhotoSeeds(thinned, score, gains)


def _check_agreement(sure: BoolArray) -> None:
    """Raise InputError where the sweep is sure of no pixel [C, H, W] at all."""
    if not sure.any():
        raise InputError(
            "photo-consistent seeds: no two views agree on any surface; check that the poses are world-to-camera with "
            "OpenCV axes, that frame 0 is synchronised, and that the images are undistorted"
        )


def _thin_with_score(cloud: PointCloud, score: FloatArray, count: int) -> tuple[PointCloud, FloatArray]:
    cells = detail_cells(cloud, count)
    xyz, rgb, mean_score = cell_means(cells, cloud.xyz, cloud.rgb, score[:, None])
    return PointCloud(xyz, rgb, cloud.origin), mean_score[:, 0]
