"""How a scene that a key packet replaces was moving, said of the rows of the key packet.

A key packet has no motion, since a player may begin with it, and its rows are stored in another order. Whoever has read
the stream up to there knows what moved before, a resumed run too, so that a fit need not begin from rest.
"""

from __future__ import annotations

import numpy as np

from gsstream.core.changes import Displacement, Scene
from gsstream.core.changes.motion import grid_places, group_means


def displacement_across_key(replaced: Scene, scene: Scene) -> Displacement | None:
    """Return the displacement of the rows of a key packet, as that of the scene before it goes on; None: it had none.

    A row has the mean displacement of the rows that are bound for its cell and its shade, as the last groups had them.
    Where none is bound for them, it is not listed.

    Arguments:
        replaced: decoded, of the frame before the key packet.
        scene: that of the key packet, decoded.
    """
    moved, groups = replaced.ahead, replaced.groups
    if moved is None or groups is None:
        return None
    old = replaced.gaussians.rows(moved.rows)
    bound = grid_places(old.means + moved.translation, old.sh0, groups.cell, groups.brightness_bins)
    here = grid_places(scene.gaussians.means, scene.gaussians.sh0, groups.cell, groups.brightness_bins)
    names, which = np.unique(bound, return_inverse=True)
    place = np.searchsorted(names, here).clip(max=len(names) - 1)
    rows = np.flatnonzero(names.take(place) == here)
    translation, rotation = (
        group_means(values, which, len(names)).take(place.take(rows), 0).astype(np.float32)
        for values in (moved.translation, moved.rotation)
    )
    return Displacement(rows, translation, rotation) if len(rows) else None
