"""Semi-global aggregation of a matching-cost volume (Hirschmueller, PAMI 2008), four paths, numpy."""

from __future__ import annotations

import numpy as np

from gsstream.core.shapes import FloatArray


def aggregate(cost: FloatArray, guide: FloatArray, step: float, jump: float, edge: float = 0.03) -> FloatArray:
    """Sum of the path costs from left, right, above and below.

    Returns [D, H, W] float32.
    """
    down = _both_ways(np.ascontiguousarray(cost.transpose(1, 0, 2)), guide, step, jump=jump, edge=edge)
    across = _both_ways(
        np.ascontiguousarray(cost.transpose(2, 0, 1)), np.ascontiguousarray(guide.T), step, jump=jump, edge=edge
    )
    total: FloatArray = down.transpose(1, 0, 2) + across.transpose(1, 2, 0)
    return total


def _both_ways(cost: FloatArray, guide: FloatArray, step: float, jump: float, edge: float) -> FloatArray:
    """Path costs along the first axis, forward plus backward; ``cost`` [S, D, R], ``guide`` [S, R]."""
    total = np.zeros_like(cost)
    contrast = np.abs(np.diff(guide, axis=0)) / np.float32(edge)
    jumps = np.maximum(jump / (1 + contrast), 1.5 * step).astype(np.float32)
    for order in (range(len(cost)), range(len(cost) - 1, -1, -1)):
        last = -1
        for s in order:
            if last < 0:
                path = cost[s].copy()
            else:
                floor = path.min(axis=0)
                reach = np.minimum(path, floor + jumps[min(s, last)])
                np.minimum(reach[1:], path[:-1] + np.float32(step), out=reach[1:])
                np.minimum(reach[:-1], path[1:] + np.float32(step), out=reach[:-1])
                # Subtracting the minimum keeps the numbers bounded along the path and changes no position of a minimum.
                reach -= floor
                reach += cost[s]
                path = reach
            total[s] += path
            last = s
    return total


def best_plane(total: FloatArray) -> FloatArray:
    """Return the [H, W] float32 index of the cheapest plane, refined by a parabola through its neighbours."""
    best = total.argmin(axis=0)
    middle = np.clip(best, 1, len(total) - 2)
    before, here, after = (np.take_along_axis(total, (middle + k)[None], axis=0)[0] for k in (-1, 0, 1))
    curvature = before - 2 * here + after
    offset = np.zeros_like(here)
    np.divide(0.5 * (before - after), curvature, out=offset, where=curvature > 1e-9)
    # At the first and last plane there is no parabola.
    refined: FloatArray = np.where(best == middle, middle + np.clip(offset, -0.5, 0.5), best)
    return refined.astype(np.float32)
