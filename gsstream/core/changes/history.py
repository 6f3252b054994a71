"""Displacement: how far rows were moved by the last frame. Both ends compute it, to predict motions from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Displacement:
    """Rows that the last frame displaced; a row that is not listed stood still.

    Arguments:
        rows: [A] int64, ascending.
        translation: [A, 3] float32 displacement of the centre, scene units per frame.
        rotation: [A, 3] float32 rotation as axis * tan(angle / 2), per frame.
    """

    rows: IntArray
    translation: FloatArray
    rotation: FloatArray

    def gathered(self, source: IntArray) -> Displacement:
        """Return the displacement of the rows afterwards; ``source`` is the result of :func:`gather_rows`."""
        kept = np.flatnonzero(np.isin(source, self.rows))
        group = np.searchsorted(self.rows, source[kept])
        return Displacement(kept, self.translation[group], self.rotation[group])

    def times(self, share: float) -> Displacement:
        """Return what goes so much farther, as far as small turns add up."""
        with np.errstate(over="ignore"):  # of a hostile stream, which nobody goes on encoding
            return Displacement(self.rows, self.translation * np.float32(share), self.rotation * np.float32(share))


def displacement_between(
    before: Gaussians[FloatArray], after: Gaussians[FloatArray], rows: IntArray
) -> Displacement | None:
    """Measure how far a frame moved and turned ``rows`` [A], all that it may have touched; None: nothing moved."""
    with np.errstate(over="ignore"):  # beyond float32 it is infinite; a motion predicted from that is refused
        translation = after.means.take(rows, 0) - before.means.take(rows, 0)
    rotation = rotation_between(before.quats.take(rows, 0), after.quats.take(rows, 0))
    # Number by number: any(1) over rows of three takes six times as long.
    some = np.flatnonzero(np.logical_or.reduce([column != 0 for column in (*translation.T, *rotation.T)]))
    return Displacement(rows.take(some), translation.take(some, 0), rotation.take(some, 0)) if len(some) else None


def rotation_between(before: FloatArray, after: FloatArray) -> FloatArray:
    """Return the rotation [A, 3] that leads from one row of quaternions [A, 4] to the other: axis * tan(angle / 2).

    float64, each sum from left to right, rounded to float32 at the end. A rotation of more than 120 degrees counts as
    none: no body rotates so far in a frame; rather the optimiser has reused the Gaussian for something else.
    """
    w0, x0, y0, z0 = before.T.astype(np.float64, order="C")
    w1, x1, y1, z1 = after.T.astype(np.float64, order="C")
    w = w1 * w0 + x1 * x0 + y1 * y0 + z1 * z0
    x = x1 * w0 - w1 * x0 - y1 * z0 + z1 * y0
    y = y1 * w0 - w1 * y0 + x1 * z0 - z1 * x0
    z = z1 * w0 - w1 * z0 - x1 * y0 + y1 * x0
    size = (w0 * w0 + x0 * x0 + y0 * y0 + z0 * z0) * (w1 * w1 + x1 * x1 + y1 * y1 + z1 * z1)
    known = (w != 0) & (4 * (w * w) >= size)
    scale = np.where(known, w, 1.0)
    rotation = [np.where(known, part / scale, 0.0).astype(np.float32) for part in (x, y, z)]
    return np.stack(rotation, 1)
