"""Clear out: Gaussians that have become transparent leave the scene."""

from __future__ import annotations

import math
from typing import final

import numpy as np
from pydantic import Field

from gsstream.api import FitContext, Growth, PartConfig, Rng, RowEdit, Scene


@final
class ExampleGrowth(Growth):
    """Removes the most transparent Gaussians of a scene after every frame; none is added."""

    source = "gsstream"

    class Config(PartConfig):
        opacity: float = Field(default=0.005, gt=0, lt=1, description="Gaussians below this opacity leave, 0 to 1")
        share: float = Field(
            default=0.01, gt=0, le=0.5, description="largest share of the Gaussians that leaves in one frame, to 0.5"
        )

    def propose(self, after: Scene, work: FitContext, rng: Rng) -> RowEdit | None:
        # Scenes hold raw values: an opacity is the sigmoid of what is stored.
        opacities, least = after.gaussians.opacities, math.log(self.config.opacity / (1 - self.config.opacity))
        faint = np.flatnonzero(opacities < least)
        most = int(self.config.share * len(opacities))
        faintest = faint[np.argsort(opacities[faint], kind="stable")][:most]
        return RowEdit(removed=np.sort(faintest)) if len(faintest) else None
