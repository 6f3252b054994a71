"""Fitting the transforms of groups to the images by damped Gauss-Newton steps, one view at a time."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
import torch

from gsstream.core.changes.motion import GroupTransforms
from gsstream.core.shapes import FloatArray
from gsstream.parts.motion.fitting import found_transforms, narrow_to
from gsstream.parts.render.work import FitContext
from gsstream.parts.render.wrt import WrtTransforms


class Damping(NamedTuple):
    """Levenberg-Marquardt damping, which shortens steps where the curvature is small."""

    relative: float  # share of the group's mean curvature, or of the mean over all groups if larger, on the diagonal
    absolute: float  # curvature added to the diagonal besides: summed over the values of an image, per pixel^2
    max_step: float  # largest change of any of the six numbers in one step, pixels


class DampedNewton:
    """Descends along the gradient of one view after another, divided by the summed curvature of the views so far.

    Because the sum grows, later views take shorter steps: after an epoch all views have the same weight (recursive
    least squares). Later epochs reuse the mean curvature of the first.
    """

    def __init__(self, values: torch.Tensor, damping: Damping) -> None:
        self.values, self._damping = values, damping
        self._total, self._measured, self._seen = values.new_zeros(len(values), 6, 6), 0, 0
        self._identity = torch.eye(6, dtype=values.dtype, device=values.device)

    def step(self, grad: torch.Tensor, curvature: torch.Tensor | None = None) -> None:
        """Replace ``values``: one step against the gradient [K, 6] of a view."""
        self._seen += 1
        if curvature is not None:
            self._total += curvature
            self._measured += 1
        matrix = self._total * (self._seen / self._measured)
        mean = matrix.diagonal(dim1=1, dim2=2).sum(1) / 6
        added = self._damping.relative * mean.maximum(mean.mean()) + self._damping.absolute
        # The variant that does not look at its result: to look, a GPU is waited for. What is damped has a solution.
        step = torch.linalg.solve_ex(matrix + added[:, None, None] * self._identity, grad[..., None]).result[..., 0]
        longest = step.abs().amax(1, keepdim=True)
        self.values = self.values - step * (self._damping.max_step / longest.clamp_min(1e-12)).clamp_max(1.0)


def fit_transforms_newton(
    work: FitContext, start: GroupTransforms[FloatArray], unit: FloatArray, iterations: int,
    order: np.random.Generator, damping: Damping, tiles: Literal["all", "changed"] = "all",
) -> FloatArray:  # fmt: skip
    """Return the translations and rotations [K, 6] of groups that minimise the loss of the images."""
    views, values = len(work.cameras), 3 * work.cameras.height * work.cameras.width
    base, local = narrow_to(work, start)
    per_step = torch.from_numpy(unit).to(base.means.device)
    squares = torch.outer(per_step, per_step)
    descent = DampedNewton(torch.cat([local.translation, local.rotation], 1) / per_step, damping)
    for step in range(iterations):
        if step % views == 0:
            sequence = order.permutation(views)
        now, view = descent.values * per_step, int(sequence[step % views])
        transforms = local._replace(translation=now[:, :3], rotation=now[:, 3:])
        found = work.loss_and_grad(view, WrtTransforms(base, transforms, curvature=step < views), tiles)
        curvature = None if found.curvature is None else found.curvature * squares * values
        descent.step(found.grad * per_step * values, curvature)
    return found_transforms(descent.values * per_step)
