"""From one depth map per view to points that several views agree on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.projection import inside, project, unproject
from gsstream.core.shapes import BoolArray, FloatArray, IntArray
from gsstream.input.seeds.geometry import pixel_centers


@dataclass(frozen=True, slots=True)
class Agreement:
    """Number of other views that support or contradict every pixel's point; all [C, H, W] int16.

    Arguments:
        support: views whose own depth there agrees.
        violation: views that see clearly farther through the point.
    """

    support: IntArray
    violation: IntArray

    def accepted(self, least: int, dominance: float) -> BoolArray:
        """Return where there are ``least`` supporters, and ``dominance`` times as many supporters as violators."""
        accepted: BoolArray = (self.support >= least) & (self.support >= dominance * self.violation)
        return accepted


def agreement(depths: FloatArray, cameras: Cameras, tolerance: float) -> Agreement:
    """Compare every pixel's point with all other depth maps; ``tolerance`` is relative to the depth."""
    shape = (len(cameras), cameras.height * cameras.width)
    support, violation = np.zeros(shape, np.int16), np.zeros(shape, np.int16)
    for view in range(len(cameras)):
        points = world_points(depths, cameras, view)
        for other in range(len(cameras)):
            if other == view:
                continue
            uv, depth = project(points, cameras, other)
            seen = np.flatnonzero(inside(uv, depth, cameras))
            column, row = uv[seen].astype(np.int64).T
            theirs = depths[other][row, column]
            support[view, seen] += np.abs(theirs - depth[seen]) < tolerance * depth[seen]
            violation[view, seen] += theirs > (1 + 3 * tolerance) * depth[seen]
    return Agreement(support.reshape(depths.shape), violation.reshape(depths.shape))


def world_points(depths: FloatArray, cameras: Cameras, view: int) -> FloatArray:
    """Return [H W, 3]: the points of one depth map."""
    return unproject(pixel_centers(cameras.width, cameras.height), depths[view].reshape(-1), cameras, view)


def interpolate_depths(depths: FloatArray, known: BoolArray, iterations: int = 300) -> FloatArray:
    """Fill unknown pixels by harmonic interpolation of inverse depth, [C, H, W].

    Inverse depth of a plane is linear in the pixel position, and a harmonic function reproduces linear ones: walls and
    floors without texture are bridged exactly. Views without any known pixel stay as they are.
    """
    wanted = known | ~known.any(axis=(1, 2), keepdims=True)
    inverse = 1 / depths
    filled: FloatArray = _fill_coarse_to_fine(np.where(wanted, inverse, 0), wanted.astype(inverse.dtype))
    for _ in range(iterations):
        padded = np.pad(filled, ((0, 0), (1, 1), (1, 1)), mode="edge")
        mean = padded[:, :-2, 1:-1] + padded[:, 2:, 1:-1] + padded[:, 1:-1, :-2] + padded[:, 1:-1, 2:]
        filled = np.where(wanted, inverse, mean * inverse.dtype.type(0.25))
    interpolated: FloatArray = 1 / filled
    return interpolated


def _fill_coarse_to_fine(values: FloatArray, weights: FloatArray) -> FloatArray:
    """Means over ever larger blocks where nothing is known: a start from which relaxation converges quickly."""
    height, width = values.shape[1:]
    known = np.divide(values, weights, out=np.zeros_like(values), where=weights > 0)
    if height == 1 and width == 1:
        return known
    coarse = _fill_coarse_to_fine(_halve(values), _halve(weights))
    spread = coarse.repeat(2, axis=1).repeat(2, axis=2)[:, :height, :width]
    return np.where(weights > 0, known, spread)


def _halve(a: FloatArray) -> FloatArray:
    even = np.pad(a, ((0, 0), (0, a.shape[1] % 2), (0, a.shape[2] % 2)))
    half: FloatArray = even[:, ::2, ::2] + even[:, 1::2, ::2] + even[:, ::2, 1::2] + even[:, 1::2, 1::2]
    return half


def color_gains(images: FloatArray, depths: FloatArray, accepted: BoolArray, cameras: Cameras) -> FloatArray:
    """Return [C, 3]: relative colour response of the cameras, geometric mean 1 per channel.

    An image is gain * common colour.

    Robust: the median ratio over accepted points seen by each pair of cameras (at least 50 of them, neither dark nor
    saturated), then least squares over the pairs. Cameras that share no points get 1.
    """
    count = len(cameras)
    rows: list[FloatArray] = []
    ratios: list[FloatArray] = []
    for view in range(count):
        keep = accepted[view].reshape(-1)
        points, colors = world_points(depths, cameras, view)[keep], images[view].reshape(-1, 3)[keep]
        for other in range(count):
            if other == view:
                continue
            ratio = _log_ratio(points, colors, images[other], depth_map=depths[other], cameras=cameras, other=other)
            if ratio is not None:
                row = np.zeros(count)
                row[view], row[other] = 1, -1
                rows.append(row)
                ratios.append(ratio)
    if not rows:
        return np.ones((count, 3), np.float32)
    # The last row, with a small weight, fixes the common factor, on which no ratio depends.
    matrix = np.concatenate([np.stack(rows), np.full((1, count), 1e-3), 1e-4 * np.eye(count)])
    right = np.concatenate([np.stack(ratios), np.zeros((1 + count, 3))])
    logs = np.linalg.lstsq(matrix, right, rcond=None)[0]
    gains: FloatArray = np.exp(logs - logs.mean(0)).astype(np.float32)
    return gains


def _log_ratio(
    points: FloatArray, colors: FloatArray, image: FloatArray, depth_map: FloatArray, cameras: Cameras, other: int
) -> FloatArray | None:
    uv, depth = project(points, cameras, other)
    seen = np.flatnonzero(inside(uv, depth, cameras))
    column, row = uv[seen].astype(np.int64).T
    visible = np.abs(depth_map[row, column] - depth[seen]) < 0.02 * depth[seen]
    mine, theirs = colors[seen[visible]], image[row[visible], column[visible]]
    usable = (np.minimum(mine, theirs) > 0.08).all(1) & (np.maximum(mine, theirs) < 0.95).all(1)
    if int(usable.sum()) < 50:
        return None
    ratio: FloatArray = np.median(np.log(mine[usable]) - np.log(theirs[usable]), axis=0)
    return ratio
