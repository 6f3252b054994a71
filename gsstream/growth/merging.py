"""Merges: two Gaussians that stand for nearly the same become one, which makes room for a birth."""

from __future__ import annotations

import numpy as np

from gsstream.core.changes import Scene
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.growth.nearest import places

#: Opacity of a merged Gaussian at most: one that hides everything has no gradient left.
MOST_OPACITY = 0.99


def closest_pairs(scene: Scene, number: int, leaving_out: IntArray) -> IntArray:
    """Return [P, 2] rows, P <= number: pairs that are nearest to each other, the pairs first that a merge harms least.

    The harm is estimated as the light of the fainter of the two times how far they differ in place and colour.

    Arguments:
        scene: as players will have it, N > 1 rows.
        number: of pairs wanted at most.
        leaving_out: rows that must not be merged.
    """
    # Imported here because it takes 30 MB, which a process that only plays or resumes a stream does not need.
    from scipy.spatial import KDTree

    points = places(scene.gaussians, scene)
    rows = np.setdiff1d(np.arange(len(points)), leaving_out)
    if len(rows) < 2:
        return np.zeros((0, 2), np.int64)
    distance, nearest = KDTree(points[rows]).query(points[rows], k=2)
    # Of two at the same place each may be named as its own neighbour.
    own = nearest[:, 0] == np.arange(len(rows))
    other = np.where(own, nearest[:, 1], nearest[:, 0])
    mutual = np.flatnonzero((other[other] == np.arange(len(rows))) & (np.arange(len(rows)) < other))
    found = np.stack([rows[mutual], rows[other[mutual]]], 1)
    light = _light(scene.gaussians)[found].min(1)
    order = np.argsort(light * distance[mutual, 1] ** 2, kind="stable")
    return np.asarray(found[order[:number]], np.int64)


def merged(gaussians: Gaussians[FloatArray], pairs: IntArray) -> Gaussians[FloatArray]:
    """Return one Gaussian for each pair, with the mean, the covariance, the mean colour and the light of both.

    Arguments:
        gaussians: N rows, raw values.
        pairs: [P, 2] rows.
    """
    light = _light(gaussians)[pairs]
    share = light / np.maximum(light.sum(1, keepdims=True), 1e-30)

    def mean(value: FloatArray) -> FloatArray:
        weights = share.reshape(*share.shape, *[1] * (value.ndim - 1))
        return np.asarray((value[pairs].astype(np.float64) * weights).sum(1))

    center = mean(gaussians.means)
    away = gaussians.means[pairs].astype(np.float64) - center[:, None]
    rows = gaussians.rows(pairs.ravel())
    spread = _covariances(rows).reshape(-1, 2, 3, 3) + away[..., :, None] * away[..., None, :]
    variance, axes = np.linalg.eigh((spread * share[..., None, None]).sum(1))
    # Columns are axes; a rotation needs a determinant of 1.
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    scales = 0.5 * np.log(np.maximum(variance, 1e-24))
    area = np.exp(scales[:, 1] + scales[:, 2])  # the two longer axes, ascending
    # Each spread over the area of both, one behind the other.
    opacity = np.clip(1 - np.prod(1 - np.minimum(light / np.maximum(area, 1e-30)[:, None], 1), 1), 1e-6, MOST_OPACITY)
    return Gaussians(
        means=center.astype(np.float32),
        quats=_quats(axes),
        scales=scales.astype(np.float32),
        opacities=np.log(opacity / (1 - opacity)).astype(np.float32),
        sh0=mean(gaussians.sh0).astype(np.float32),
        shN=mean(gaussians.shN).astype(np.float32),
    )


def _light(gaussians: Gaussians[FloatArray]) -> FloatArray:
    """[N] opacity times the area of the ellipse of the two longer axes, scene units squared."""
    longer = np.sort(gaussians.scales.astype(np.float64), 1)[:, 1:].sum(1)
    return np.asarray(np.exp(longer) / (1 + np.exp(-gaussians.opacities.astype(np.float64))))


def _covariances(gaussians: Gaussians[FloatArray]) -> FloatArray:
    """[N, 3, 3] of each Gaussian, scene units squared."""
    from scipy.spatial.transform import Rotation

    quats = gaussians.quats.astype(np.float64)
    quats[np.linalg.norm(quats, axis=1) < 1e-10] = (1, 0, 0, 0)  # which scipy refuses
    turn = Rotation.from_quat(np.roll(quats, -1, axis=1)).as_matrix()
    scaled = turn * np.exp(gaussians.scales.astype(np.float64))[:, None, :]
    return np.asarray(scaled @ scaled.transpose(0, 2, 1))


def _quats(rotations: FloatArray) -> FloatArray:
    """[P, 4] w first, float32, of rotation matrices [P, 3, 3]."""
    from scipy.spatial.transform import Rotation

    found = Rotation.from_matrix(rotations).as_quat() if len(rotations) else np.zeros((0, 4))
    return np.asarray(np.roll(found, 1, axis=1), np.float32)
