"""What is known of a scene before frame 0 is optimised: from its training cameras, their images and the seeds."""

from __future__ import annotations

import numpy as np

from gsstream.core.auto import SceneFacts
from gsstream.core.errors import InputError
from gsstream.core.frame import Frame, PointCloud
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.engine.auto.colour_gain import colour_gain

_GREY = np.array([0.299, 0.587, 0.114], np.float32)
#: Number of seeds that facts are estimated from; more would not change a quantile.
MOST_SEEDS = 4000
#: Seeds whose nearest neighbour among all is looked for.
MOST_NEIGHBOURS = 500


def scene_facts(points: PointCloud, frame: Frame) -> SceneFacts:
    """Return the facts that rules of ``auto`` choose by. Test cameras have no part in them.

    Raises InputError without points or training cameras.
    """
    cameras = frame.cameras
    if len(points) == 0 or len(cameras) == 0:
        raise InputError(
            f"'auto' needs seeds and training cameras to choose by; got {len(points)} seeds and {len(cameras)} "
            "cameras: give values instead"
        )
    xyz = points.xyz[_spread(len(points), MOST_SEEDS)].astype(np.float64)
    distances = np.linalg.norm(xyz[:, None] - cameras.centers[None], axis=2)
    near, median, far = (float(q) for q in np.quantile(distances, [0.001, 0.5, 0.999]))
    span = float(np.ptp(points.xyz.astype(np.float64), axis=0).max())
    focal = float(np.median(cameras.Ks[:, 0, 0]))
    return SceneFacts(
        cameras=len(cameras),
        width=cameras.width,
        height=cameras.height,
        seeds=len(points),
        span_pixels=span * focal / median if median > 0 else 0.0,
        span_spacings=span / spacing if (spacing := _spacing(points.xyz.astype(np.float64))) > 0 else 1.0,
        distance_ratio=far / near if near > 0 else float("inf") if far > 0 else 1.0,
        closeness=_closeness(distances, far),
        texture=_texture(frame.images),
        colour_gain=colour_gain(frame.images, cameras, xyz),
    )


def _spread(count: int, most: int) -> IntArray:
    """At most ``most`` row numbers, evenly spread over the cloud."""
    rows: IntArray = np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))
    return rows


def _spacing(xyz: FloatArray) -> float:
    """Median distance of a seed to its nearest neighbour at another place; 0 when all are at one."""
    nearest = []
    for row in _spread(len(xyz), MOST_NEIGHBOURS):
        distance = np.square(xyz - xyz[row]).sum(1)
        apart = distance[distance > 0]
        if len(apart):
            nearest.append(float(apart.min()))
    return float(np.sqrt(np.median(nearest))) if nearest else 0.0


def _closeness(distances: FloatArray, far: float) -> tuple[float, float, float, float, float]:
    kept = np.quantile(distances, 0.9, axis=1)
    if far <= 0:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    # A seed at a camera is as close as one can be; the far distance is a quantile, so that some seeds lie beyond it.
    ratio = np.log(far / np.maximum(kept, 1e-6 * far)).clip(0)
    a, b, c, d, e = (float(q) for q in np.quantile(ratio, [0.9, 0.7, 0.5, 0.3, 0.1]))
    return a, b, c, d, e


def _texture(images: FloatArray) -> float:
    grey = images @ _GREY
    whole = float(np.abs(grey - grey.mean(dtype=np.float64)).mean(dtype=np.float64))
    if whole == 0:
        return 0.0
    steps = [np.abs(np.diff(grey, axis=axis)).mean(dtype=np.float64) for axis in (1, 2) if grey.shape[axis] > 1]
    return float(np.mean(steps)) / whole if steps else 0.0
