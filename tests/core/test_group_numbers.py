"""Groups of rows are numbered by cell, then by brightness, whichever way that is found: against Python's sorting."""

from __future__ import annotations

import numpy as np
import pytest

from gsstream.core.changes import Layout, Scene, groups_for
from gsstream.core.changes.motion import HALF_GRID, MAX_CELLS_PER_ROW
from gsstream.core.gaussians import SH0, Gaussians

ROWS, CELL = 300, 0.25


@pytest.mark.parametrize("reach", [1.0, 30.0, 1e7])
@pytest.mark.parametrize("brightness_bins", [1, 5])
def test_groups_are_numbered_as_sorting_their_cells_would(reach: float, brightness_bins: int) -> None:
    """Rows whose cells fit into a table, rows too far apart for one, and rows beyond the end of the grid."""
    rng = np.random.default_rng(2)
    means = (reach * rng.uniform(-1, 1, (ROWS, 3)) ** 3).astype(np.float32)
    colours = rng.normal(size=(ROWS, 1, 3)).astype(np.float32)
    gaussians = Gaussians(means, np.ones((ROWS, 4), np.float32), means, means[:, 0], colours, colours[:, :0])
    layout = Layout(np.array([ROWS], np.int32), np.zeros(ROWS, np.uint8), np.float32([1]))
    groups = groups_for(Scene(gaussians, layout), CELL, brightness_bins)

    index = np.floor(means.astype(np.float64) / CELL)
    cells = np.clip(index, -HALF_GRID, HALF_GRID - 1).astype(int)
    assert (np.ptp(cells, axis=0).prod() > MAX_CELLS_PER_ROW * ROWS) == (reach > 1), "both ways are looked at"
    red, green, blue = colours[:, 0].astype(np.float64).T
    bright = 0.5 + SH0 * (0.25 * red + 0.5 * green + 0.25 * blue)
    tones = np.clip(np.floor(bright * brightness_bins), 0, brightness_bins - 1).astype(int).tolist()
    names = [(*cell, tone) for cell, tone in zip(cells.tolist(), tones, strict=True)]
    order = sorted(set(names))
    assert groups.count == len(order)
    assert groups.group_of.dtype == np.int32
    assert groups.group_of.tolist() == [order.index(name) for name in names]
