"""Iterations go where something changed: of the tiles in which nothing did, each one looks at a few, drawn anew.

Candidates reach far beyond what changed: on a recording of people they cover nearly every tile of every view. A tile
that did not change, and lies beside none that did, holds them to where they were, and a few of these quiet tiles say
that as well as all: those that are drawn count for those that are not, so that the gradient is right on average
(docs/results/cost.md).
"""

from __future__ import annotations

import torch


class QuietTiles:
    """Draws the tiles that an iteration looks at.

    Arguments:
        near: [V, ceil(H / 16), ceil(W / 16)] bool, tiles that changed or lie beside one that did, which are always
            looked at; None where all tiles are.
        share: of the other tiles that an iteration looks at, in (0, 1]; with 1 nothing is drawn.
        generator: of the draws.
    """

    def __init__(self, near: torch.Tensor | None, share: float, generator: torch.Generator) -> None:
        self._near, self._share, self._generator = near, share, generator

    def weights(self, view: int) -> torch.Tensor | None:
        """Return [ceil(H / 16), ceil(W / 16)] float32 factors on the gradients of tiles; None: all count once.

        Arguments:
            view: index of a training camera.
        """
        if self._near is None or self._share == 1:
            return None
        near = self._near[view]
        drawn = torch.rand(near.shape, generator=self._generator) < self._share
        return torch.where(near, 1.0, drawn / self._share)
