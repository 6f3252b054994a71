"""Fitting the transforms of groups to the images by damped Gauss-Newton steps, one view at a time."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
import torch

from gsstream.core.changes import Scene
from gsstream.core.changes.motion import GroupTransforms
from gsstream.core.shapes import FloatArray
from gsstream.parts.render.work import FitContext
from gsstream.parts.render.wrt import WrtTransforms


class Damping(NamedTuple):
    """Levenberg-Marquardt damping, which shortens steps where the curvature is small.

    Arguments:
        relative: share of the group's mean curvature, or of the mean over all groups if larger, on the diagonal.
        absolute: curvature added to the diagonal besides: summed over the values of an image, per pixel^2.
        max_step: largest change of any of the six numbers in one step, pixels.
    """

    relative: float
    absolute: float
    max_step: float


class DampedNewton:
    """Descends along the gradient of one view after another, divided by the summed curvature of the views so far.

    Because the sum grows, later views take shorter steps: after an epoch all views have the same weight (recursive
    least squares). Later epochs reuse the mean curvature of the first.
    """

    def __init__(self, values: FloatArray, damping: Damping) -> None:
        self.values, self._damping = values, damping
        self._total, self._measured, self._seen = np.zeros((len(values), 6, 6)), 0, 0

    def step(self, grad: FloatArray, curvature: FloatArray | None = None) -> None:
        """Replace ``values``: one step against the gradient [K, 6] of a view."""
        self._seen += 1
        if curvature is not None:
            self._total += curvature
            self._measured += 1
        matrix = self._total * (self._seen / self._measured)
        mean = np.trace(matrix, axis1=1, axis2=2) / 6
        added = self._damping.relative * np.maximum(mean, mean.mean()) + self._damping.absolute
        step = np.linalg.solve(matrix + added[:, None, None] * np.eye(6), grad[..., None])[..., 0]
        longest = np.abs(step).max(1, keepdims=True)
        self.values = self.values - step * np.minimum(1.0, self._damping.max_step / np.maximum(longest, 1e-12))


def fit_transforms_newton(
    scene: Scene, work: FitContext, start: GroupTransforms, unit: FloatArray, iterations: int,
    order: np.random.Generator, damping: Damping, tiles: Literal["all", "changed"] = "all",
) -> FloatArray:  # fmt: skip
    """Return the translations and rotations [K, 6] of groups that minimise the loss of the images."""
    views, values = len(work.cameras), 3 * work.cameras.height * work.cameras.width
    work.narrow(torch.from_numpy(start.rows))
    base = scene.gaussians.rows(start.rows).map(torch.from_numpy)
    local = start._replace(rows=np.arange(len(start.rows)))
    descent = DampedNewton(np.concatenate([start.translation, start.rotation], 1) / unit, damping)
    for step in range(iterations):
        if step % views == 0:
            sequence = order.permutation(views)
        now, view = descent.values * unit, int(sequence[step % views])
        transforms = local._replace(translation=now[:, :3], rotation=now[:, 3:])
        found = work.loss_and_grad(view, WrtTransforms(base, transforms, curvature=step < views), tiles)
        curvature = None if found.curvature is None else found.curvature.numpy() * np.outer(unit, unit) * values
        descent.step(found.grad.numpy() * unit * values, curvature)
    return np.asarray(descent.values * unit)
