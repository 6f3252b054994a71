"""A sphere of large seeds behind the scene, so that walls, floor and sky have a place other than near a lens.

Where few cameras see a wall, a fit that has nothing behind the scene explains it with a cloud in front of each camera.
Which Gaussians belong to the sphere follows from where they are and how large: nothing has to be sent or kept for it,
so that a resumed run, a later key packet and a scene that is taken over know it, too.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.errors import InputError
from gsstream.core.focus import meeting_point
from gsstream.core.frame import PointCloud
from gsstream.core.projection import inside, project
from gsstream.core.shapes import BoolArray, FloatArray

#: Seeds of the sphere.
SEEDS = 256
#: Radius in mean distances of the cameras from what they look at; in extents of a rig that looks at nothing in common.
RADIUS, OUTWARD_RADIUS = 1.5, 4.0
#: Standard deviation of a seed, in distances between neighbours.
WIDTH = 0.6
#: What lies beyond this share of the radius and is wider than this share of a seed belongs to the shell.
BEYOND, WIDE = 0.75, 0.5


class Shell(NamedTuple):
    """A sphere around the scene: its centre [3], its radius, and the standard deviation of its seeds, scene units."""

    center: FloatArray
    radius: float
    sigma: float


def mean_color(images: FloatArray) -> tuple[float, float, float]:
    """Return the mean colour of all pixels of images [C, H, W, 3]. Raises InputError where there are none."""
    if not images.size:
        raise InputError("frame 0 has no training images: expected those of at least 1 camera, got 0")
    cameras, height, width = images.shape[:3]
    # Rows first: a sum over all three axes at once takes five times as long.
    columns = images.reshape(cameras * height, width * 3).sum(0, dtype=np.float64)
    red, green, blue = (columns.reshape(width, 3).sum(0) / (cameras * height * width)).clip(0, 1).tolist()
    return red, green, blue


def find_shell(cameras: Cameras) -> Shell:
    """Return the sphere of a rig: around what its cameras look at, else (side by side, outwards) around themselves."""
    centers, focus = cameras.centers, meeting_point(cameras)
    depth = np.zeros(1) if focus is None else np.einsum("ci,ci->c", cameras.viewmats[:, 2, :3], focus - centers)
    widest = np.linalg.norm(centers[:, None] - centers[None], axis=2).max(initial=0)
    # Axes that are nearly parallel may meet right before the lenses; those of one place meet there.
    if focus is not None and widest > 0 and (depth > 0.25 * widest).all():
        radius = RADIUS * float(np.linalg.norm(centers - focus, axis=1).mean())
    else:
        focus, radius = centers.mean(0), OUTWARD_RADIUS * cameras.extent
    return Shell(focus, radius, WIDTH * radius * math.sqrt(4 * math.pi / SEEDS))


def shell_points(images: FloatArray, cameras: Cameras) -> PointCloud:
    """Return the seeds: nearly even on the sphere (Fibonacci's spiral), each with the median colour where it is seen.

    Arguments:
        images: [C, H, W, 3] in [0, 1]. cameras: the C training cameras.
    """
    shell, step = find_shell(cameras), np.arange(SEEDS) + 0.5
    polar, around = np.arccos(1 - 2 * step / SEEDS), np.pi * (1 + 5**0.5) * step
    way = np.stack([np.cos(around) * np.sin(polar), np.sin(around) * np.sin(polar), np.cos(polar)], 1)
    xyz = (shell.center + shell.radius * way).astype(np.float32)
    return PointCloud(xyz, _colors(xyz.astype(np.float64), images, cameras), "a sphere behind the scene")


def in_shell(means: FloatArray, scales: FloatArray, shell: Shell) -> BoolArray:
    """Return [N] bool: which Gaussians are what became of the sphere's seeds.

    Arguments:
        means: [N, 3] centres. scales: [N, 3] log standard deviations. shell: sphere that belongs to the training
            cameras.
    """
    far = ((means - shell.center) ** 2).sum(1) >= (BEYOND * shell.radius) ** 2
    found: BoolArray = far & (scales.max(1) >= math.log(WIDE * shell.sigma))
    return found


def _colors(points: FloatArray, images: FloatArray, cameras: Cameras) -> FloatArray:
    """[P, 3] median colour over the views that see each point; the mean of all images where none does."""
    samples = np.full((len(cameras), len(points), 3), np.nan, np.float32)
    for view in range(len(cameras)):
        uv, depth = project(points, cameras, view)
        seen = inside(uv, depth, cameras)
        column, row = uv[seen].astype(np.int64).T
        samples[view, seen] = images[view][row, column]
    colors = np.empty((len(points), 3), np.float32)
    colors[:] = mean_color(images)
    known = ~np.isnan(samples[..., 0]).all(0)
    colors[known] = np.nanmedian(samples[:, known], axis=0)
    return colors
