"""Which groups are better off where a motion leads than where they stand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from gsstream.core.changes.motion import GroupTransforms
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.parts.motion.fitting import narrow_to
from gsstream.parts.render.work import FitContext
from gsstream.parts.render.wrt import WrtTransforms


def loss_change(
    work: FitContext, transforms: GroupTransforms[FloatArray], views: Sequence[int] | IntArray
) -> FloatArray:
    """Return the change [K] of the loss, summed over views, that each group's move brings about; below 0 it helps.

    It is the derivative of the loss half-way, along the move: for a loss that is quadratic between the two ends it is
    their difference, and one pass over the views answers for every group at once.
    """
    base, whole = narrow_to(work, transforms)
    half = whole._replace(translation=whole.translation / 2, rotation=whole.rotation / 2)
    grad = torch.stack([work.loss_and_grad(int(view), WrtTransforms(base, half)).grad for view in views]).sum(0)
    change: FloatArray = (grad * torch.cat([whole.translation, whole.rotation], 1)).sum(1).cpu().numpy()
    return change


def rotating_views(number: int, share: float, frame: int) -> IntArray:
    """Return the views that take their turn in a frame: a share of all, evenly spread, others in the next frame."""
    count = max(1, round(share * number))
    return np.unique((np.arange(count) * number // count + frame) % number)
