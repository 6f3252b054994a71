"""How many Gaussians frame 0 may have: what its images can pin down.

A fit with more parameters than its images have evidence for describes the training cameras, not the scene: cameras that
are left out see it get worse while training cameras see it get better. Which of those that have grown stay is another
question (``removal.py``).
"""

from __future__ import annotations

from gsstream.core.frame import Frame
from gsstream.recipe.model import FirstFrame


def most_gaussians(settings: FirstFrame, frame: Frame) -> int:
    """Return the number of Gaussians that growth may reach: the cap, or fewer where there are few pixels.

    Arguments:
        settings: section ``first_frame`` of the recipe.
        frame: training images of frame 0.
    """
    if settings.pixels_per_gaussian == 0:
        return settings.max_gaussians
    pixels = frame.images[..., 0].size
    return min(settings.max_gaussians, max(1, int(pixels / settings.pixels_per_gaussian)))
