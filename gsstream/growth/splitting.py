"""Splits: a Gaussian that is stretched over what is wrong becomes two."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gsstream.core.context import FrameWork
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.growth.judging import ErrorMap, landing

#: Halves stand this many standard deviations before and behind the centre, and are this much shorter: together they
#: have the mean and the variance of the one they replace.
APART, SHORTER = 0.75, (1 - 0.75**2) ** 0.5


def stretched(
    gaussians: Gaussians[FloatArray], work: FrameWork, maps: Mapping[int, ErrorMap], pixels: float
) -> IntArray:
    """Return the rows whose longest axis exceeds so many pixels and whose centre lies in wrong pixels; longest first.

    Arguments:
        gaussians: N rows, raw values.
        work: the frame.
        maps: where the views are wrong.
        pixels: standard deviation, in pixels of the view in which it is largest; 0: none.
    """
    if pixels == 0:
        return np.zeros(0, np.int64)
    longest = np.exp(gaussians.scales.astype(np.float64)).max(1)
    size, hits = np.zeros(len(gaussians)), np.zeros(len(gaussians), np.int64)
    for view, one in maps.items():
        at = landing(gaussians.means, work.cameras, view)
        size[at.inside] = np.maximum(size, longest * work.cameras.Ks[view, 0, 0] / at.depth)[at.inside]
        rows, columns = at.row[at.inside].astype(np.int64), at.column[at.inside].astype(np.int64)
        hits[at.inside] += one.wrong.numpy()[rows, columns]
    rows = np.flatnonzero((size > pixels) & (hits >= 2))
    return rows[np.argsort(-size[rows], kind="stable")]


def halves(parents: Gaussians[FloatArray]) -> Gaussians[FloatArray]:
    """Return two Gaussians for each, one behind the other, which together cover what it covered.

    Arguments:
        parents: P rows, raw values.
    """
    number = len(parents)
    axis = parents.scales.argmax(1)
    quats = parents.quats.astype(np.float64)
    w, x, y, z = (quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12)).T
    columns = np.stack([
        np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], 1),
        np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], 1),
        np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], 1),
    ], 1)  # fmt: skip
    picked = np.arange(number)
    way = columns[picked, axis] * np.exp(parents.scales[picked, axis].astype(np.float64))[:, None] * APART
    scales = parents.scales.copy()
    scales[picked, axis] += np.float32(np.log(SHORTER))
    out = {name: np.repeat(value, 2, 0) for name, value in parents.items()}
    out["means"] = (np.repeat(parents.means, 2, 0) + np.stack([-way, way], 1).reshape(-1, 3)).astype(np.float32)
    out["scales"] = np.repeat(scales, 2, 0)
    return Gaussians(**out)
