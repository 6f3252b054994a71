"""Real spherical harmonics in the order and with the signs of 3DGS, and how they turn with the world."""

from __future__ import annotations

import functools

import numpy as np

from gsstream.core.gaussians import SH0
from gsstream.core.shapes import FloatArray

_SH1 = 0.4886025119029199
_SH2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
_SH3 = (
    0.5900435899266435,
    2.890611442640554,
    0.4570457994644658,
    0.3731763325901154,
    1.445305721320277,
)


def sh_basis(directions: FloatArray, degree: int) -> FloatArray:
    """Return [(degree + 1)^2, N]: the harmonics, up to degree 3, of unit directions [N, 3]."""
    x, y, z = directions.T
    basis = [np.full_like(x, SH0)]
    if degree > 0:
        basis += [-_SH1 * y, _SH1 * z, -_SH1 * x]
    if degree > 1:
        a, b, c = _SH2
        basis += [a * x * y, -a * y * z, b * (2 * z * z - x * x - y * y), -a * x * z, c * (x * x - y * y)]
    if degree > 2:
        a, b, c, d, e = _SH3
        basis += [
            -a * y * (3 * x * x - y * y),
            b * x * y * z,
            -c * y * (5 * z * z - 1),
            d * z * (5 * z * z - 3),
            -c * x * (5 * z * z - 1),
            e * z * (x * x - y * y),
            -a * x * (x * x - 3 * y * y),
        ]
    return np.stack(basis)


def rotate_sh(shN: FloatArray, rotation: FloatArray) -> FloatArray:
    """Return coefficients [N, K - 1, 3], of degree 1 and above, of the same colours after the world was turned.

    The colour that was seen from direction d is seen from ``rotation @ d`` afterwards, ``rotation`` [3, 3]. Harmonics
    of one degree turn among themselves, so each degree has a matrix, found from their values in more directions than
    there are coefficients.
    """
    degree = round((shN.shape[1] + 1) ** 0.5) - 1
    turned = np.array(shN, np.float64)
    before, after = sh_basis(_directions(), degree), sh_basis(_directions() @ rotation.T, degree)
    for band in range(1, degree + 1):
        rows = slice(band**2, (band + 1) ** 2)
        matrix = np.linalg.lstsq(after[rows].T, before[rows].T, rcond=None)[0]
        higher = slice(rows.start - 1, rows.stop - 1)  # shN begins at degree 1
        turned[:, higher] = np.einsum("ij,njc->nic", matrix, turned[:, higher])
    return turned


@functools.cache
def _directions() -> FloatArray:
    """[64, 3] directions spread evenly over the sphere (a Fibonacci lattice)."""
    index = np.arange(64) + 0.5
    z, angle = 1 - index / 32, np.pi * (1 + 5**0.5) * index
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], 1)
