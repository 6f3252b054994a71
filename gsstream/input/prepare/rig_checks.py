"""What a calibration alone gives away: intrinsics, placement, axes, overlap. Nothing is decoded."""

from __future__ import annotations

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.focus import meeting_point
from gsstream.core.frame import PointCloud
from gsstream.core.projection import unproject
from gsstream.core.shapes import FloatArray
from gsstream.input.prepare.findings import Finding, error, warning
from gsstream.input.seeds.geometry import depth_range, visible_views

FAR = 30.0
MIN_OVERLAP = 0.05


def check_intrinsics(cameras: Cameras) -> list[Finding]:
    """Find principal points far from the centres of images, and focal lengths that no real lens has."""
    found = []
    width, height = cameras.width, cameras.height
    for name, K in zip(cameras.ids, cameras.Ks, strict=True):
        share = np.array([K[0, 2] / width, K[1, 2] / height])
        point = f"({K[0, 2]:.0f}, {K[1, 2]:.0f})"
        where = f"camera {name!r}: the principal point is at {point} of {width} x {height} pixels"
        scale = 2 * share.mean()
        if abs(scale - 1) > 0.3 and abs(share[0] - share[1]) < 0.1 * share.mean():
            found.append(
                error(
                    "intrinsics",
                    f"{where}; K looks like that of images of {round(width * scale)} x {round(height * scale)}. "
                    f"Multiply the first two rows of K by {1 / scale:.3g}",
                )
            )
        elif not ((share > 0) & (share < 1)).all():
            found.append(error("intrinsics", f"{where}, outside of the image; check cx and cy (pixels, not fractions)"))
        elif abs(share - 0.5).max() > 0.25:
            found.append(warning("intrinsics", f"{where}, far from the centre; check cx and cy"))
        angles = np.degrees(2 * np.arctan(np.array([width / K[0, 0], height / K[1, 1]]) / 2))
        if angles.max() > 150 or angles.min() < 2:
            found.append(
                error(
                    "intrinsics",
                    f"camera {name!r}: focal lengths {K[0, 0]:.4g} and {K[1, 1]:.4g} pixels mean a field of view "
                    f"of {angles[0]:.0f} x {angles[1]:.0f} degrees; expected 2 to 150. Give focal lengths in "
                    "pixels",
                )
            )
    return found


def check_placement(cameras: Cameras, train: int, points: PointCloud | None) -> list[Finding]:
    """Find two cameras in one place, a camera far from all others, and points in another unit.

    ``train``: the first so many cameras train.
    """
    found = []
    centers = cameras.centers
    gaps = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    size = float(np.median(gaps[gaps > 0])) if (gaps > 0).any() else 0.0
    turned = np.einsum("aij,bij->ab", cameras.viewmats[:, :3, :3], cameras.viewmats[:, :3, :3]) > 3 - 1e-4
    same = np.argwhere(np.triu((gaps <= 1e-4 * size) & turned, 1))
    for a, b in same:
        leak = a < train <= b
        advice = "nothing is tested that was not trained on: take one of them out" if leak else "take one of them out"
        kinds = "a training camera and a test camera" if leak else "two cameras"
        found.append(
            error(
                "placement",
                f"cameras {cameras.ids[a]!r} and {cameras.ids[b]!r}, {kinds}, have the same pose; {advice}, or "
                "correct w2c",
            )
        )
    if len(same) == 0 and len(cameras) > 3:
        middle = np.median(centers, axis=0)
        distance = np.linalg.norm(centers - middle, axis=1)
        usual = float(np.median(distance))
        found = [
            error(
                "placement",
                f"camera {cameras.ids[i]!r} is {distance[i]:.4g} units away from the middle of the rig, the others "
                f"about {usual:.4g}; its translation is probably in another unit (mm instead of m?)",
            )
            for i in np.flatnonzero(distance > FAR * max(usual, 1e-12))
        ]
    if not found and points is not None and len(points) > 10:
        found = _points_unit(cameras, points)
    return found


def _points_unit(cameras: Cameras, points: PointCloud) -> list[Finding]:
    spread = float(np.median(np.linalg.norm(points.xyz - np.median(points.xyz, axis=0), axis=1)))
    ratio = spread / cameras.extent
    if 1 / FAR < ratio < FAR:
        return []
    return [
        error(
            "placement",
            f"the points of frame 0 spread over {spread:.4g} units, the rig over {cameras.extent:.4g}: one of "
            "them is probably in mm and the other in m; bring poses and points to one unit",
        )
    ]


def check_axes(cameras: Cameras) -> list[Finding]:
    """Find cameras that have the point where their axes meet behind them."""
    focus = meeting_point(cameras)
    if len(cameras) < 3 or focus is None:
        return []
    depth = (cameras.viewmats[:, 2, :3] @ focus) + cameras.viewmats[:, 2, 3]
    across = np.linalg.norm(cameras.viewmats[:, 2, :3] - cameras.viewmats[:, 2, :3].mean(0), axis=1)
    if (depth < 0).all() and float(across.mean()) > 0.1:
        return [
            error(
                "axes",
                "every camera has the point where the optical axes meet behind it: the poses look like those of "
                "OpenGL (y up, z backwards). Multiply the second and third row of w2c by -1. A rig that looks "
                "outwards has no common view to reconstruct",
            )
        ]
    return []


def check_overlap(cameras: Cameras, names: tuple[str, ...]) -> list[Finding]:
    """Find each of ``names`` that shares no part of its view with another training camera.

    Depths worth searching are considered.
    """
    if len(cameras) < 2:
        return [error("overlap", "there is one training camera; expected at least two with a common view")]
    found = []
    for name in names:
        i = cameras.ids.index(name)
        others = [j for j in range(len(cameras)) if j != i]
        seen = visible_views(_view_points(cameras, i), cameras)[:, others]
        share = float(seen.any(1).mean())
        if share < MIN_OVERLAP:
            found.append(
                error(
                    "overlap",
                    f"camera {name!r} shares its view with no other training camera ({100 * share:.0f} % of it); "
                    "check its pose, or take it out",
                )
            )
    return found


def _view_points(cameras: Cameras, i: int) -> FloatArray:
    """World points on a grid of pixels and depths of one camera."""
    near, far = depth_range(cameras)[i]
    x, y, depth = np.meshgrid(
        np.linspace(0, cameras.width, 9), np.linspace(0, cameras.height, 7), np.geomspace(near, far, 8)
    )
    return unproject(np.stack([x.ravel(), y.ravel()], axis=1), depth.ravel(), cameras, i)
