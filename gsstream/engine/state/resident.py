"""What stays on the renderer's device from frame to frame, so that only what changed crosses."""

from __future__ import annotations

from typing import NamedTuple

import torch

from gsstream.core.gaussians import Gaussians
from gsstream.core.hierarchy import Hierarchy
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.engine.fit.frame_images import FrameImages


class Resident(NamedTuple):
    """The decoded scene, its groups and the images that it shows, on the renderer's device."""

    gaussians: Gaussians[torch.Tensor]
    hierarchy: Hierarchy
    images: FrameImages


def updated(
    before: Gaussians[torch.Tensor], after: Gaussians[FloatArray], rows: IntArray
) -> Gaussians[torch.Tensor]:
    """Return the scene ``after`` on the device of ``before``; only ``rows`` [A], all that differ, are copied to it."""
    device = before.means.device
    if device.type == "cpu":
        return after.map(torch.from_numpy)
    index = torch.from_numpy(rows).to(device)
    changed = after.rows(rows).map(lambda value: torch.from_numpy(value).to(device))
    return Gaussians(**{name: value.index_copy(0, index, getattr(changed, name)) for name, value in before.items()})
