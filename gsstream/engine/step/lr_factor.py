"""How the learning rates of a frame's residual fall."""

from __future__ import annotations

import math


def lr_factor(final: float, iteration: int, iterations: int) -> float:
    """Return the factor on the learning rates of a frame's residual at an iteration: it falls exponentially from 1.

    Arguments:
        final: factor at the last iteration, in (0, 1]; 1: the rates stay as they are.
        iteration: counted from 0.
        iterations: of the frame, as far as is known now; a frame of one iteration has the full rates.
    """
    return math.pow(final, iteration / max(1, iterations - 1))
