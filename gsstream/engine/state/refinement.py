"""A first frame that goes on being optimised beside the stream, as it is between two frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch

from gsstream.core.gaussians import Gaussians
from gsstream.engine.fit.densify import DensifyStatistics


@dataclass(frozen=True)
class Refinement:
    """All Gaussians of a scene in training, which no player has yet. Nothing in it is changed once it is made.

    It follows from the first key packet, the packets since and their pictures, so a resumed run makes it again.
    """

    gaussians: Gaussians[torch.Tensor]  # [B] rows, raw values
    levels: torch.Tensor  # [B] int64 octree level of each
    ancestors: torch.Tensor  # [B] int64 row of the players' scene that each came from; -1: that one is gone
    #: Attribute -> Adam state of its rows (``RowParameters.moments``); empty before the first iteration.
    moments: Mapping[str, Mapping[str, torch.Tensor]]
    statistics: DensifyStatistics  # of the screen gradients since Gaussians were last added
    iterations: int  # made so far
