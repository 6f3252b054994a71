"""Where Gaussians may be born: where some fixed views changed, and not too many in one place."""

from __future__ import annotations

import numpy as np
import torch

from gsstream.api import FitContext, IntArray
from gsstream.blocks import pixel_size
from gsstream_quarc.settings import GateSettings


def change_scores(work: FitContext, views: int) -> torch.Tensor:
    """Return [N] the change score g / (g + median) of every Gaussian, 0 to 1; 0 where g is 0.

    g is the length of the change, from the frame before to this one, of the squared error's gradient by a Gaussian's
    2-D mean, summed over the views; the render itself cancels. The median is that of the Gaussians whose g is not 0.
    """
    size = torch.zeros(len(work.gaussians))
    number = len(work.cameras)
    for view in np.unique(np.linspace(0, number - 1, min(views, number)).round().astype(int)):
        now = work.image(int(view))
        upstream = 2 * (work.previous_image(int(view)) - now) / now.numel()
        size += work.screen_gradient(int(view), upstream).gradient.norm(dim=1)
    reached = size > 0
    if not bool(reached.any()):
        return size
    return size / (size + size[reached].median())


class ChangeFilter:
    """Chooses places for births: those that changed, at most some in a cell."""

    def __init__(self, settings: GateSettings, kept: int) -> None:
        """Prepare the choice."""
        self.settings, self.kept = settings, kept

    def __call__(self, work: FitContext, rows: torch.Tensor) -> torch.Tensor:
        """Return the rows that may be copied, in the order in which they come."""
        settings, means = self.settings, work.gaussians.means.numpy()
        if settings.score:
            rows = rows[change_scores(work, settings.views)[rows] >= settings.score]
        side = settings.pixels * pixel_size(means, work.cameras)
        index = np.floor(means.astype(np.float64) / side).astype(np.int64)
        cell_of = np.unique(index, axis=0, return_inverse=True)[1].reshape(-1)
        room = settings.per_cell - np.bincount(cell_of[self.kept :], minlength=int(cell_of.max(initial=0)) + 1)
        cells = cell_of[rows.numpy()]
        return rows[torch.from_numpy(_ranks(cells) < room[cells])]


def _ranks(cells: IntArray) -> IntArray:
    """[P]: how many before each are of the same cell."""
    order = np.argsort(cells, kind="stable")
    ordered = cells[order]
    first = np.flatnonzero(np.diff(ordered, prepend=-1))
    ranks = np.empty(len(cells), np.int64)
    ranks[order] = np.arange(len(cells)) - np.repeat(first, np.diff(first, append=len(cells)))
    return ranks
