"""How strictly a run checks the values that parts return: off, frame or step (``GSSTREAM_CHECKS``).

Nothing that is sent depends on the level: it decides when a wrong number is noticed, and how precisely it is named.
"""

from __future__ import annotations

import os
from enum import StrEnum

from gsstream.core.errors import InputError

VARIABLE = "GSSTREAM_CHECKS"
UNIT = (0.0, 1.0)


class Checks(StrEnum):
    """Levels of looking; each looks at all that the one before it does.

    off: types and shapes at the seams alone. frame: also every number that crosses a seam, once per frame, the penalty
    in every iteration (the default). step: also gates, images, losses, gradients and parameters in every iteration.
    """

    OFF = "off"
    FRAME = "frame"
    STEP = "step"


def requested_checks(given: str | None = None) -> Checks:
    """Return the level ``given``, else that of the environment, else "frame". Raises InputError for any other."""
    where = "checks" if given is not None else VARIABLE
    text = given if given is not None else os.environ.get(VARIABLE, "") or Checks.FRAME
    try:
        return Checks(text)
    except ValueError:
        known = ", ".join(Checks)
        raise InputError(f"{where}: expected one of {known}, got {text!r}") from None
