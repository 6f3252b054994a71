"""Groups: which rows move together, as both ends of a stream know it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsstream.core.shapes import IntArray


@dataclass(frozen=True, slots=True)
class Groups:
    """Which group each row belongs to.

    Arguments:
        cell: side of a cell, scene units; rows of one cell and one shade are a group.
        brightness_bins: number of classes of brightness, 1 to 16.
        group_of: [N] int32 group of each row.
        count: G, the number of groups; some may have lost all their rows since.
    """

    cell: float
    brightness_bins: int
    group_of: IntArray
    count: int

    def gathered(self, source: IntArray) -> Groups | None:
        """Return the groups of the rows afterwards; an added Gaussian joins the group of the row stored before it.

        Without any row that was there before, there is nothing to join: None.
        """
        old = source < len(self.group_of)
        if not bool(old.any()):
            return None
        before = np.maximum.accumulate(np.where(old, np.arange(len(source)), -1))
        before[before < 0] = int(np.argmax(old))
        return replace(self, group_of=self.group_of[source[before]])
