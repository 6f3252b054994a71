"""The gradient of a view's loss by the transforms of groups of rows, in one native call."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsstream.api import Comparison, Gaussians, MovedPull, Moves
from gsstream_cpu_render import _native
from gsstream_cpu_render.arrays import SplatArrays
from gsstream_cpu_render.loss import weighted
from gsstream_cpu_render.native import native_scene


def moved_slope(
    rasterizer: Any, compared: Any, rows: Gaussians[NDArray[Any]], moves: Moves, comparison: Comparison, curved: bool
) -> MovedPull | None:
    """Return loss, gradient and curvature as ``gsstream.api.RenderSession.pull_moved``; None where there is a fault.

    Arguments:
        rasterizer: native, frozen to the rows.
        compared: ``comparison`` as the kernels take it.
        rows: [A] before they move. moves: of these rows.
        comparison: what the render is compared with. curved: return the curvature, too.
    """
    groups = len(moves.centre)
    slope, curvature = np.empty((groups, 6)), np.empty((groups, 6, 6)) if curved else None
    place = np.ascontiguousarray(moves.place, np.int64)
    transforms = [np.ascontiguousarray(part, np.float64) for part in (moves.centre, moves.shift, moves.turn)]
    splats = SplatArrays(*(np.ascontiguousarray(value, np.float32) for _, value in rows.items()))
    given = rasterizer, native_scene(splats), compared, place, *transforms, slope
    # Kernels that were built before curvature was measured have no place for it.
    faults, l1, dssim = _native.pull_moved(*given, curvature) if curved else _native.pull_moved(*given)
    values = comparison.target.image.size
    loss = weighted(l1, dssim, comparison.dssim, 1.0 / values)
    if faults or not np.isfinite(loss):
        return None
    return MovedPull(loss, slope, None if curvature is None else curvature / values)
