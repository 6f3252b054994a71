"""Progressive training: which units (octree levels) take part at which moment of a frame."""

from __future__ import annotations

import numpy as np

from gsstream.core.shapes import IntArray
from gsstream.recipe.model import Stream

#: Iterations of a level in multiples of those of the level before, N_{i+1} = omega N_i: the paper leaves omega open.
OMEGA = 1.5


def level_schedule(stream: Stream, unit_of: IntArray) -> tuple[tuple[float, int], ...]:
    """Return pairs (fraction of the frame until which, finest level that takes part) (paper, supplement).

    The H levels are those that hold Gaussians: a structure may have more, of which the finest are often empty, and a
    schedule over empty levels would delay no row. It starts at level floor(H / 2); each finer level's stage is
    omega times longer, N_{i+1} = omega N_i. Empty without ``stream.progressive``, or when there is only one stage.
    The paper leaves omega and the treatment of inactive levels open: here they keep their previous attributes, and
    their gates start from the confidence when their turn comes.
    """
    if not stream.progressive:
        return ()
    levels = np.unique(unit_of).tolist()
    waiting = levels[len(levels) // 2 :]
    if len(waiting) < 2:
        return ()
    weights = [OMEGA**i for i in range(len(waiting))]
    ends = np.cumsum(weights) / sum(weights)
    return tuple(zip(ends.tolist(), waiting, strict=True))


def current_level(schedule: tuple[tuple[float, int], ...], fraction: float) -> int:
    """Return the finest level that takes part at this fraction [0, 1) of the frame's iterations."""
    return next((level for end, level in schedule if fraction < end), schedule[-1][1])
