"""Light: one factor a channel on the colours of the whole scene, as when a lamp is switched on."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsstream.core.changes.scene import Scene
from gsstream.core.errors import ShapeError
from gsstream.core.gaussians import SH0
from gsstream.core.shapes import FloatArray

#: A factor lies between the inverse of this and this: what is white leaves a level of 255 in the dark.
MOST_FACTOR = 256.0


@dataclass(frozen=True, slots=True)
class Light:
    """Every colour, and the background, becomes ``factor`` times as bright.

    Arguments:
        factor: red, green, blue, each 1/256 to 256 and a value of binary16, as which it is sent
            (:func:`sendable_factor`).
    """

    factor: tuple[float, float, float]

    @property
    def is_empty(self) -> bool:
        """Whether no channel changes."""
        return self.factor == (1.0, 1.0, 1.0)

    def problem(self) -> str | None:
        """Say what is wrong with the factors; None when nothing is."""
        got = np.asarray(self.factor, np.float64)
        if got.shape != (3,) or not ((got >= 1 / MOST_FACTOR) & (got <= MOST_FACTOR)).all():
            return f"factor: expected three numbers from {1 / MOST_FACTOR:g} to {MOST_FACTOR:g}, got {self.factor}"
        if (got != got.astype(np.float16)).any():
            return f"factor: expected values of binary16 (sendable_factor), got {self.factor}"
        return None


def sendable_factor(factor: FloatArray) -> tuple[float, float, float]:
    """Return the factors [3] of binary16 that are nearest, within the limits of a packet."""
    limited = np.clip(np.asarray(factor, np.float64), 1 / MOST_FACTOR, MOST_FACTOR)
    red, green, blue = (float(value) for value in limited.astype(np.float16))
    return red, green, blue


def apply_light(scene: Scene, light: Light) -> Scene:
    """Return the scene in another light, float32; nothing but its colours changes.

    A colour is 0.5 + SH0 sh0 + ..., so that sh0 gets a factor and an offset, and shN the factor. Raises ShapeError when
    the factors are not those of a packet, or a value leaves float32.
    """
    if problem := light.problem():
        raise ShapeError(f"light: {problem}")
    factor, old = np.asarray(light.factor, np.float32), scene.gaussians
    offset = ((np.asarray(light.factor, np.float64) - 1) * (0.5 / SH0)).astype(np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        sh0, shN = old.sh0 * factor + offset, old.shN * factor
    if not (np.isfinite(sh0).all() and np.isfinite(shN).all()):
        raise ShapeError(f"light: factors {light.factor} lead colours out of the range of float32")
    return replace(scene, gaussians=replace(old, sh0=sh0, shN=shN))


def lit_background(background: tuple[float, float, float], light: Light) -> tuple[float, float, float]:
    """Return the background in another light, values of float32. Raises ShapeError when one leaves float32."""
    with np.errstate(over="ignore"):
        after = np.asarray(background, np.float32) * np.asarray(light.factor, np.float32)
    if not np.isfinite(after).all():
        raise ShapeError(f"light: factors {light.factor} lead the background {background} out of the range of float32")
    red, green, blue = (float(value) for value in after)
    return red, green, blue
