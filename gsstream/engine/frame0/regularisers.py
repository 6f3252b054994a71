"""What keeps frame 0 from explaining each picture on its own: it depends on the training cameras.

The bounds were chosen on left-out training cameras (docs/results/extremes.md).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from gsstream.core.cameras import Cameras
from gsstream.core.gaussians import Gaussians
from gsstream.input.seeds.room import stands_around
from gsstream.recipe.model import FirstFrame

#: Cameras up to which a rig is regularised at all: with more of them, both measures lose detail.
FEW = 8
#: Share of the Gaussians that is left out.
DROPOUT = 0.2
#: Weight of the smoothness of depth, and a number of cameras. In a room that the cameras stand in, smoothness pays with
#: that many or more: walls are smooth, but fewer cameras place them too badly. Where all look from one side it pays
#: with fewer: more cameras tell depth better than smoothness does.
SMOOTHNESS, SMOOTHNESS_CAMERAS = 1.0, 6
#: Smoothness counts in every second iteration, after a tenth of all: at the start no depth is worth keeping.
SMOOTHNESS_EVERY, SMOOTHNESS_FROM = 2, 0.1
#: Largest opacity of a Gaussian that stands in for those that are left out.
MOST_OPAQUE = 0.9999


@dataclass(frozen=True, slots=True)
class Regularisers:
    """Share of the Gaussians that an iteration leaves out, and weight of the smoothness of depth; 0: none."""

    dropout: float
    depth_smoothness: float

    def smoothness_at(self, iteration: int, iterations: int) -> float:
        """Return the weight in one iteration of the schedule; 0 in those in which it takes no part."""
        if iteration % SMOOTHNESS_EVERY or iteration < SMOOTHNESS_FROM * iterations:
            return 0.0
        return SMOOTHNESS_EVERY * self.depth_smoothness


def choose_regularisers(settings: FirstFrame, cameras: Cameras) -> Regularisers:
    """Return the regularisers for so many training cameras; none where the recipe switches them off."""
    if not settings.few_cameras or len(cameras) > FEW:
        return Regularisers(0.0, 0.0)
    pays = (len(cameras) >= SMOOTHNESS_CAMERAS) == stands_around(cameras)
    return Regularisers(DROPOUT, SMOOTHNESS if pays else 0.0)


class Dropout:
    """Leaves a share of the Gaussians out of each iteration.

    Which ones is drawn for some iterations at a time, so that what is drawn crosses to a GPU once in a while.

    Arguments:
        share: share of the Gaussians that is left out, 0 to below 1.
        ahead: number of iterations that are drawn for at a time.
        generator: random generator of the draws; it is used only where something is left out.
    """

    def __init__(self, share: float, ahead: int, generator: torch.Generator) -> None:
        self._share, self._ahead, self._generator = share, ahead, generator
        self._keep: list[torch.Tensor] = []

    def thin_out(self, rows: Gaussians[torch.Tensor]) -> tuple[Gaussians[torch.Tensor], torch.Tensor | None]:
        """Return the rows with the opacity that makes up for those left out, and which [N] are kept (None: all)."""
        share, count = self._share, len(rows)
        if share == 0:
            return rows, None
        if not self._keep or len(self._keep[-1]) != count:  # none is left, or they were drawn for another scene
            drawn = torch.rand(self._ahead, count, generator=self._generator) >= share
            self._keep = list(drawn.to(rows.opacities.device))
        opacities = torch.logit((rows.opacities.sigmoid() / (1 - share)).clamp(max=MOST_OPAQUE))
        return replace(rows, opacities=opacities), self._keep.pop()
