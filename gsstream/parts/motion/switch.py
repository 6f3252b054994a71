"""Which groups are better off where a motion leads than where they stand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from gsstream.core.changes import Scene
from gsstream.core.changes.motion import GroupTransforms
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.parts.render.work import FitContext
from gsstream.parts.render.wrt import WrtTransforms


def loss_change(
    scene: Scene, work: FitContext, transforms: GroupTransforms, views: Sequence[int] | IntArray
) -> FloatArray:
    """Return the change [K] of the loss, summed over views, that each group's move brings about; below 0 it helps.

    It is the slope of the loss half-way, along the move: for a loss that is quadratic between the two ends it is their
    difference, and one pass over the views answers for every group at once.
    """
    work.narrow(torch.from_numpy(transforms.rows))
    base = scene.gaussians.rows(transforms.rows).map(torch.from_numpy)
    half = transforms._replace(
        rows=np.arange(len(transforms.rows)), translation=transforms.translation / 2, rotation=transforms.rotation / 2
    )
    grads = (work.loss_and_grad(view, WrtTransforms(base, half)).grad.numpy() for view in views)
    grad = sum(grads, np.zeros((len(transforms.center), 6)))
    return np.asarray((grad * np.concatenate([transforms.translation, transforms.rotation], 1)).sum(1))


def rotating_views(number: int, share: float, frame: int) -> IntArray:
    """Return the views that take their turn in a frame: a share of all, evenly spread, others in the next frame."""
    count = max(1, round(share * number))
    return np.unique((np.arange(count) * number // count + frame) % number)
