"""How the learning rates of a frame's residual fall."""

from __future__ import annotations

import math


def lr_factor(final: float, iteration: int, iterations: int) -> float:
    """Return the factor on the learning rates of a frame's residual at an iteration: it falls exponentially from 1."""
    return math.pow(final, iteration / max(1, iterations - 1))
