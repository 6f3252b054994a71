"""Copies where some fixed views changed, and not too many in one place."""

from __future__ import annotations

from functools import partial
from typing import final

import numpy as np
import torch
from pydantic import Field

from gsstream.api import FitContext, Growth, IntArray, Rng, RowEdit, Scene
from gsstream.blocks import CopySettings, enlargement, least_opaque, pixel_size, replace_with_copies


@final
class ChangeGatedCopies(Growth):
    """Copies Gaussians where four fixed views changed, at most four in a cell of a grid (QuARC-GS, 2026).

    As many of the least opaque Gaussians leave as the scene has more Gaussians than the last key packet.
    """

    source = "QuARC-GS (arXiv 2608.18285)"
    processor_only = "it chooses places by numpy"

    class Config(CopySettings):
        views: int = Field(default=4, ge=1, description="training cameras, spread over the rig, whose change counts")
        score: float = Field(
            default=0.5, ge=0, lt=1, description="least change score g / (g + median) of a place; 0: everywhere"
        )
        per_cell: int = Field(default=4, ge=1, description="added Gaussians in a cell of a grid at most")
        pixels: float = Field(default=6.0, gt=0, le=1000, description="side of these cells, pixels at a width of 320")

    def propose(self, after: Scene, work: FitContext, rng: Rng) -> RowEdit | None:
        rows = least_opaque(after, len(after.gaussians) - work.key_rows)
        return replace_with_copies(
            after, rows, work, settings=self.config, rng=rng, admitted=partial(self.admitted, work.key_rows)
        )

    def admitted(self, kept: int, work: FitContext, rows: torch.Tensor) -> torch.Tensor:
        """Return which of ``rows`` may be copied, in their order, in a scene whose rows from ``kept`` on are copies."""
        config, means = self.config, work.gaussians.means.numpy()
        if config.score:
            rows = rows[change_scores(work, config.views)[rows] >= config.score]
        side = config.pixels * enlargement(work.cameras.width) * pixel_size(means, work.cameras)
        index = np.floor(means.astype(np.float64) / side).astype(np.int64)
        cell_of = np.unique(index, axis=0, return_inverse=True)[1].reshape(-1)
        room = config.per_cell - np.bincount(cell_of[kept:], minlength=int(cell_of.max(initial=0)) + 1)
        cells = cell_of[rows.numpy()]
        return rows[torch.from_numpy(_ranks(cells) < room[cells])]


def change_scores(work: FitContext, views: int) -> torch.Tensor:
    """Return [N] the change score g / (g + median) of every Gaussian, 0 to 1; 0 where g is 0.

    g is the length of the change, from the frame before to this one, of the squared error's gradient by a Gaussian's
    2-D mean, summed over the views; the render itself cancels. The median is taken over the Gaussians whose g is not 0.
    """
    size = torch.zeros(len(work.gaussians))
    number = len(work.cameras)
    for view in np.unique(np.linspace(0, number - 1, min(views, number)).round().astype(int)):
        change = work.image_change(int(view))
        size += work.screen_gradient(int(view), -2 * change / change.numel()).gradient.norm(dim=1)
    reached = size > 0
    if not bool(reached.any()):
        return size
    return size / (size + size[reached].median())


def _ranks(cells: IntArray) -> IntArray:
    """[P]: how many before each are of the same cell."""
    order = np.argsort(cells, kind="stable")
    ordered = cells[order]
    first = np.flatnonzero(np.diff(ordered, prepend=-1))
    ranks = np.empty(len(cells), np.int64)
    ranks[order] = np.arange(len(cells)) - np.repeat(first, np.diff(first, append=len(cells)))
    return ranks
