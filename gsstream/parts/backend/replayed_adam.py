"""Adam of a GPU, whose residual optimisers replay their iterations."""

from __future__ import annotations

from typing import Any, final

import torch

from gsstream.core.gaussians import Gaussians
from gsstream.parts.backend.adam import ReferenceAdam
from gsstream.parts.residual.layout import JointLayout
from gsstream.parts.residual.optimiser import ResidualOptimiser
from gsstream.parts.residual.replayed import ReplayedResidualOptimiser


@final
class ReplayedAdam(ReferenceAdam):
    """Steps are those of the reference, in torch on the device."""

    def residual_optimiser(
        self, code: JointLayout, base: Gaussians[torch.Tensor], units: torch.Tensor, matrix: torch.Tensor
    ) -> ResidualOptimiser[Any]:
        return ReplayedResidualOptimiser(code=code, base=base, units=units, matrix=matrix, optimiser=self)
