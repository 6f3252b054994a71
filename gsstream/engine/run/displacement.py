"""How far Gaussians travel on the screen from frame to frame."""

from __future__ import annotations

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.projection import inside, project
from gsstream.core.shapes import FloatArray
from gsstream.packet import PlayerState


def displacement_pixels(player: PlayerState, cameras: Cameras) -> dict[str, float]:
    """Return the median and the largest way on the screen of the rows that the last frame displaced, pixels."""
    displacement = player.scene.displacement
    if displacement is None:
        return {"median": 0.0, "max": 0.0}
    after = player.gaussians.means[displacement.rows]
    ways = screen_displacement(after - displacement.translation, after, cameras)
    ways = ways[np.isfinite(ways)]
    return {"median": float(np.median(ways)), "max": float(ways.max())} if len(ways) else {"median": 0.0, "max": 0.0}


def screen_displacement(before: FloatArray, after: FloatArray, cameras: Cameras) -> FloatArray:
    """Return [P] pixels between two places of each point, mean over the cameras that see both; nan: none does."""
    total, count = np.zeros(len(before)), np.zeros(len(before))
    for view in range(len(cameras)):
        (start, near), (end, far) = project(before, cameras, view), project(after, cameras, view)
        both = inside(start, near, cameras) & inside(end, far, cameras)
        total[both] += np.linalg.norm(end[both] - start[both], axis=1)
        count += both
    ways: FloatArray = np.divide(total, count, out=np.full(len(before), np.nan), where=count > 0)
    return ways
