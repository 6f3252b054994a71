"""How a quantity drifts along a sequence, and the memory a run took."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np


def slope_per_100(frames: Sequence[int], values: Sequence[float]) -> float:
    """Return the least-squares slope in units per 100 frames; nan for fewer than two different frames.

    Values must be finite.
    """
    x, y = np.asarray(frames, np.float64), np.asarray(values, np.float64)
    if len(x) < 2 or np.ptp(x) == 0:
        return math.nan
    x = x - x.mean()
    return float(100 * (x @ y) / (x @ x))


def peak_memory_mb() -> float:
    """Return the largest resident memory of this process so far, MB (10^6 bytes). nan where the system is silent."""
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024 / 1e6
    if sys.platform == "win32":
        return math.nan
    import resource

    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return used / 1e6 if sys.platform == "darwin" else used * 1024 / 1e6
