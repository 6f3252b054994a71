"""Pictures larger than the recorded ones: Gaussians that are as blurred as in the recorded picture, enlarged.

A footprint in a picture is S = J C J^T + b I: the covariance C [3, 3] of a Gaussian in camera coordinates, projected by
J, and b = 0.3 square pixels. The Gaussians were optimised with that b in recorded pixels. Enlarged s times, the
recorded picture has the footprint s^2 S, so b of the larger picture is 0.3 s^2; with 0.3, what was as wide as a pixel
becomes a needle. A renderer adds 0.3 itself. What is missing, d = 0.3 (s^2 - 1), is put into C: the first two columns
of J are (fx / z, 0) and (0, fy / z), so that along the camera's x and y axes the variances d (z / fx)^2 and
d (z / fy)^2 come to d I in the picture, wherever the Gaussian is, and limits of the third column do not matter.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray
from gsstream.player.software import BLUR, rotation_matrices


def enlarged(
    gaussians: Gaussians[FloatArray], viewmat: FloatArray, K: FloatArray, scale: float
) -> Gaussians[FloatArray]:
    """Return the Gaussians that a renderer draws in a picture ``scale`` times as large as the recorded one.

    Arguments:
        gaussians: N rows, raw values; those of a picture that is not larger are returned as they are.
        viewmat: [4, 4] world to camera.
        K: [3, 3] intrinsics of the larger picture, pixels.
        scale: pixels of the picture for one of the recorded.
    """
    if scale <= 1 or not len(gaussians):
        return gaussians
    depth = gaussians.means.astype(np.float64) @ viewmat[2, :3] + viewmat[2, 3]
    with np.errstate(over="ignore", invalid="ignore"):
        spread = np.exp(gaussians.scales.astype(np.float64))
        axes = rotation_matrices(gaussians.quats.astype(np.float64)) * spread[:, None]
        covariance = axes @ axes.transpose(0, 2, 1)
        for axis, focal in ((viewmat[0, :3], K[0, 0]), (viewmat[1, :3], K[1, 1])):
            added = BLUR * (scale * scale - 1) * (depth / focal) ** 2
            covariance += added[:, None, None] * np.outer(axis, axis)
    # Behind the camera nothing is drawn, and what is beyond numbers is the renderer's to refuse.
    rows = np.flatnonzero((depth > 0) & np.isfinite(covariance).all((1, 2)))
    variances, rotations = np.linalg.eigh(covariance[rows])
    # Axes have no sign, a rotation has.
    rotations[:, :, 0] *= np.sign(np.linalg.det(rotations))[:, None]
    quats, scales = gaussians.quats.copy(), gaussians.scales.copy()
    quats[rows] = _quaternions(rotations)
    scales[rows] = 0.5 * np.log(np.maximum(variances, np.finfo(np.float32).tiny))
    return replace(gaussians, quats=quats, scales=scales)


def _quaternions(r: FloatArray) -> FloatArray:
    """[N, 4] wxyz of rotations [N, 3, 3], by the largest of their four components (Shepperd)."""
    a, b, c = r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]
    d, e, f = r[:, 0, 1] + r[:, 1, 0], r[:, 0, 2] + r[:, 2, 0], r[:, 1, 2] + r[:, 2, 1]
    x, y, z = r[:, 0, 0], r[:, 1, 1], r[:, 2, 2]
    squares = (1 + x + y + z, 1 + x - y - z, 1 - x + y - z, 1 - x - y + z)
    rows = ((squares[0], a, b, c), (a, squares[1], d, e), (b, d, squares[2], f), (c, e, f, squares[3]))
    table = np.array(rows).transpose(2, 0, 1)
    chosen = table[np.arange(len(r)), np.argmax(squares, 0)]
    return np.asarray(chosen / np.linalg.norm(chosen, axis=1, keepdims=True))
