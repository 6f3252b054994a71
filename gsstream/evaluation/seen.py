"""Which pixels of a test camera show a surface that training cameras see: the others can only be guessed.

A surface that no training camera sees looks in a picture as chance will have it. On a recording of large pictures 4 %
of the pixels held half of the squared error, and their chance turned rankings round (docs/results/extremes.md). The
surface is that of the decoded scene: its own depth, drawn for the test camera and for every training camera.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.gaussians import SH0, Gaussians
from gsstream.core.shapes import BoolArray, FloatArray
from gsstream.player.render import PlayerRenderer, render

#: Training cameras that must see a surface: one alone does not say where it is.
MIN_CAMERAS = 2
#: Largest difference of two depths of one surface, as a share of the depth. In rendered pictures 1352 wide, 98.3 % of
#: the pixels are then judged as the true depth would judge them; with 0.02, 95.2 %.
TOLERANCE = 0.05
#: Least share of a pixel's light that must come from Gaussians, else nothing is there that could be seen.
MIN_ALPHA = 0.5


def draw_depths(
    scene: Gaussians[FloatArray], cameras: Cameras, view: int, renderer: PlayerRenderer | None = None
) -> FloatArray:
    """Return the depth [H, W] of a scene, scene units; inf where hardly anything is drawn.

    It is one over the mean inverse depth of what a pixel shows, weighted as its colours are.
    """
    pose = cameras.viewmats[view]
    depth = np.maximum(scene.means.astype(np.float64) @ pose[2, :3] + pose[2, 3], cameras.near_plane)
    # Inverse depth and 1 are drawn as two channels on black: the second says how much light is from Gaussians.
    colors = np.column_stack([cameras.near_plane / depth, np.ones_like(depth), np.zeros_like(depth)])
    sh0 = ((colors - 0.5) / SH0).astype(np.float32)[:, None]
    shown = replace(scene, sh0=sh0, shN=np.zeros((len(depth), 0, 3), np.float32))
    image = render(shown, cameras, view, background=(0.0, 0.0, 0.0), renderer=renderer).astype(np.float64)
    inverse, alpha = image[..., 0] / cameras.near_plane, image[..., 1]
    solid = (alpha >= MIN_ALPHA) & (inverse > 0)
    return np.asarray(np.where(solid, alpha / np.where(solid, inverse, 1), np.inf))


def seen_masks(
    scene: Gaussians[FloatArray], training: Cameras, cameras: Cameras, renderer: PlayerRenderer | None = None
) -> list[BoolArray]:
    """Return for each of ``cameras`` [H, W] bool: pixels of a decoded scene whose surface two training cameras see."""
    depths = [draw_depths(scene, cameras, view, renderer) for view in range(len(cameras))]
    solid = [np.isfinite(depth) for depth in depths]
    points = [_backproject(cameras, view, depths[view], solid[view]) for view in range(len(cameras))]
    counts = [np.zeros(len(of), np.int32) for of in points]
    # The depth of one training camera at a time: the depths of a large rig together would fill the memory.
    for view in range(len(training)):
        depth = draw_depths(scene, training, view, renderer)
        for count, of in zip(counts, points, strict=True):
            count += _sees(training, view, depth, of)
    masks = []
    for where, count in zip(solid, counts, strict=True):
        mask = np.zeros(where.shape, np.bool_)
        mask[where] = count >= MIN_CAMERAS
        masks.append(mask)
    return masks


def _sees(cameras: Cameras, view: int, depth: FloatArray, points: FloatArray) -> BoolArray:
    """[N] bool: points [N, 3] that lie on the surface which a camera sees in their pixel, at the depths [H, W]."""
    pose, K = cameras.viewmats[view], cameras.Ks[view]
    local = points @ pose[:3, :3].T + pose[:3, 3]
    z = local[:, 2]
    front: BoolArray = z > cameras.near_plane
    safe = np.where(front, z, 1.0)
    u, v = (K[axis, axis] * local[:, axis] / safe + K[axis, 2] for axis in (0, 1))
    height, width = depth.shape
    front &= (u >= 0) & (v >= 0) & (u < width) & (v < height)
    column, row = (np.where(front, at, 0).astype(np.int64) for at in (u, v))
    return np.asarray(front & (np.abs(depth[row, column] - z) <= TOLERANCE * z))


def _backproject(cameras: Cameras, view: int, depth: FloatArray, where: BoolArray) -> FloatArray:
    """[N, 3] points in the world of the pixels [H, W] that are marked."""
    row, column = np.nonzero(where)
    K, pose, z = cameras.Ks[view], cameras.viewmats[view], depth[where]
    x = (column + 0.5 - K[0, 2]) / K[0, 0] * z
    y = (row + 0.5 - K[1, 2]) / K[1, 1] * z
    return np.asarray((np.column_stack([x, y, z]) - pose[:3, 3]) @ pose[:3, :3])
