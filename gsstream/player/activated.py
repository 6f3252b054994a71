"""Values as other programs hold them: linear scales, unit quaternions xyzw, opacities from 0 to 1."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gsstream.core.errors import InputError
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray


@dataclass(frozen=True, slots=True)
class Activated:
    """N Gaussians after activation, float32.

    Arguments:
        means: [N, 3] centres, units of the file.
        quats: [N, 4] unit quaternions, xyzw.
        scales: [N, 3] standard deviations, units of the file, at least 0.
        opacities: [N] in [0, 1].
        harmonics: [N, K, 3] coefficients, degree by degree and order by order; colour = 0.5 + their sum.
    """

    means: FloatArray
    quats: FloatArray
    scales: FloatArray
    opacities: FloatArray
    harmonics: FloatArray

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        """Degree of the harmonics, 0 to 3."""
        return math.isqrt(self.harmonics.shape[1]) - 1


def activated(scene: Gaussians[FloatArray]) -> Activated:
    """Return what a scene is after activation. Raises InputError for sizes and places beyond the range of float32."""
    quats = scene.quats[:, [1, 2, 3, 0]].astype(np.float64)
    with np.errstate(over="ignore"):
        scales = np.exp(scene.scales.astype(np.float64))
    beyond = (np.abs(np.concatenate([scales, scene.means], 1)) > np.finfo(np.float32).max).any(1)
    if beyond.any():
        raise InputError(
            f"the file holds float32, and {int(beyond.sum())} of {len(scene)} Gaussians are larger or farther than "
            "that reaches; export ply, which holds sizes as logarithms"
        )
    return Activated(
        means=scene.means.astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=scales.astype(np.float32),
        # The sigmoid, in a form that overflows nowhere.
        opacities=(0.5 * (1 + np.tanh(scene.opacities.astype(np.float64) / 2))).astype(np.float32),
        harmonics=np.concatenate([scene.sh0, scene.shN], 1).astype(np.float32),
    )
