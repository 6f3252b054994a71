"""Fixed-threshold pruning: confidence below a threshold does not count at all."""

from __future__ import annotations

import math
from typing import final

import torch
from pydantic import Field

from gsstream.api import Hierarchy, PartConfig, Propagation, PropagationTraits, check_finite, check_shape, tree_max


@final
class FixedThreshold(Propagation):
    """p_j = max over the tree of (p_i where p_i >= tau, else 0) (paper, appendix "Propagation Strategy Analysis").

    On logits: z_i >= logit(tau) passes, every other z_i becomes ``floor``, since the logit of 0 is minus infinity. The
    maximum of a tree is given to all its nodes. Monotone and idempotent, but not conservative: trees whose members are
    all below tau close, which is what the paper holds against it.
    """

    source = 'S2GS, appendix "Propagation Strategy Analysis"'

    class Config(PartConfig):
        tau: float = Field(
            default=0.8, gt=0, lt=1, description="Gaussians below this probability are ignored, 0 to 1 (paper: >= 0.5)"
        )
        floor: float = Field(
            default=-50.0, ge=-1e4, le=-10, description="logit that stands for probability 0, -1e4 to -10"
        )

    traits = PropagationTraits(idempotent=True, differentiable=True, parent_bound=True)

    def propagate(self, logits: torch.Tensor, hierarchy: Hierarchy) -> torch.Tensor:
        """[N] logits -> [M] logits. Raises ShapeError for a wrong length, a value that is not finite, or a cycle."""
        check_shape("logits", logits, (hierarchy.num_gaussians,))
        check_finite("logits", logits)
        tau = self.config.tau
        # A logit below the floor already is closed; lifting it to the floor would invent suspicion.
        kept = torch.where(logits >= math.log(tau) - math.log1p(-tau), logits, logits.clamp_max(self.config.floor))
        return tree_max(kept, hierarchy, self.config.floor)
