"""The Gaussian of a scene that a newborn one is most like."""

from __future__ import annotations

import numpy as np

from gsstream.core.changes import Scene
from gsstream.core.gaussians import SH0, Gaussians
from gsstream.core.shapes import FloatArray, IntArray

#: A difference of colour of the whole range counts as far as this many units of the layout.
FAR = 1.0


def alike(born: Gaussians[FloatArray], scene: Scene) -> IntArray:
    """Return [B] the row of the scene nearest to each newborn Gaussian in place and colour.

    A newborn joins its node and so its gate and its group. What looks alike and stands nearby is likely one body.

    Arguments:
        born: B rows, raw values.
        scene: as players will have it, N > 0 rows.
    """
    # Imported here because it takes 30 MB, which a process that only plays or resumes a stream does not need.
    from scipy.spatial import KDTree

    return np.asarray(KDTree(places(scene.gaussians, scene)).query(places(born, scene))[1], np.int64)


def places(rows: Gaussians[FloatArray], scene: Scene) -> FloatArray:
    """Return [R, 6]: place, in units of the layout, and colour of each, so that near means near and alike.

    Arguments:
        rows: R rows, raw values.
        scene: whose layout has the units.
    """
    unit = float(np.median(scene.layout.units))
    return np.concatenate([rows.means / unit, rows.sh0[:, 0] * (SH0 * FAR)], 1)
