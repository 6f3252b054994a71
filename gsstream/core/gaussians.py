"""Gaussians: raw (pre-activation) per-Gaussian arrays under the field's names."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from gsstream.core.errors import ShapeError
from gsstream.core.shapes import check_finite, check_shape

Array = TypeVar("Array")
Other = TypeVar("Other")

#: Attribute names in the order used by every table, packet and optimiser group.
ATTRIBUTES = ("means", "quats", "scales", "opacities", "sh0", "shN")
#: Value of the spherical harmonic of degree 0: colour = 0.5 + SH0 * sh0.
SH0 = 0.28209479177387814


@dataclass(frozen=True, slots=True)
class Gaussians(Generic[Array]):
    """N anisotropic 3D Gaussians. Numpy arrays in codec and player, torch tensors in the engine.

    Arguments:
        means: [N, 3] centres, scene units.
        quats: [N, 4] rotation, wxyz, any non-zero norm (normalised by the renderer).
        scales: [N, 3] natural logarithm of the standard deviations, scene units.
        opacities: [N] logit of the opacity.
        sh0: [N, 1, 3] degree-0 spherical-harmonic coefficients (colour = 0.5 + 0.2820948 * sh0).
        shN: [N, K - 1, 3] higher-degree coefficients; K in {1, 4, 9, 16}.
    """

    means: Array
    quats: Array
    scales: Array
    opacities: Array
    sh0: Array
    shN: Array

    def __len__(self) -> int:
        return int(self.means.shape[0])  # type: ignore[attr-defined]

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return math.isqrt(int(self.shN.shape[1]) + 1) - 1  # type: ignore[attr-defined]

    def items(self) -> Iterator[tuple[str, Array]]:
        """Yield (attribute name, array) in the order of ATTRIBUTES."""
        return ((name, getattr(self, name)) for name in ATTRIBUTES)

    def map(self, function: Callable[[Array], Other]) -> Gaussians[Other]:
        """Apply a function to every attribute array."""
        return Gaussians(**{name: function(value) for name, value in self.items()})

    def rows(self, index: Any) -> Gaussians[Array]:
        """Select rows by an index array or a boolean mask."""
        return self.map(lambda a: a[index])  # type: ignore[index]

    def validate(self) -> None:
        """Raise ShapeError if a shape disagrees, a value is not finite, or K is not a square up to 16."""
        n = len(self)
        shapes: dict[str, tuple[int | str, ...]] = {
            "means": (n, 3),
            "quats": (n, 4),
            "scales": (n, 3),
            "opacities": (n,),
            "sh0": (n, 1, 3),
            "shN": (n, "R", 3),
        }
        for name, array in self.items():
            check_shape(name, array, shapes[name])
            check_finite(name, array)
        bases = int(self.shN.shape[1]) + 1  # type: ignore[attr-defined]
        if bases not in (1, 4, 9, 16):
            raise ShapeError(f"shN: expected 0, 3, 8 or 15 coefficients (degree 0 to 3), got {bases - 1}")
