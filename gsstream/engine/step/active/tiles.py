"""Which tiles an iteration looks at: where something changed, all; of the others a few, drawn anew each time.

Candidates reach far beyond what changed: on a recording of people they cover nearly every tile of every view. A tile
that did not change, and lies beside none that did, holds them to where they were, and a few of these quiet tiles say
that as well as all: those that are drawn count for those that are not, so that the gradient is right on average
(docs/results/cost.md).
"""

from __future__ import annotations

import torch

from gsstream.engine.step.active.change import Change


def tile_weights(change: Change | None, view: int, share: float, generator: torch.Generator) -> torch.Tensor | None:
    """Return [ceil(H / 16), ceil(W / 16)] float32 factors on the gradients of a view's tiles; None: all count once."""
    if change is None or share == 1:
        return None
    near = change.dilated[view]
    drawn = (torch.rand(near.shape, generator=generator) < share).to(near.device)
    return torch.where(near, 1.0, drawn / share)


def changed_tile_weights(change: Change | None, view: int) -> torch.Tensor | None:
    """Return the factors where no quiet tile is looked at."""
    return None if change is None else change.dilated[view].float()
