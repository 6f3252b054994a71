"""Fitting the transforms of groups to the images, one view at a time, with Adam's moments."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch

from gsstream.core.changes.motion import GroupTransforms
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray, check_finite
from gsstream.parts.render.work import FitContext
from gsstream.parts.render.wrt import WrtTransforms

BETAS, EPSILON = (0.9, 0.99), 1e-12
#: Squared gradients [K, 6] -> by what every number's gradient is divided, squared.
Measure = Callable[[torch.Tensor], torch.Tensor]


class GroupAdam:
    """Descends along gradients with Adam's moments, in steps of given length.

    Arguments:
        values: [K, 6] float64, where it begins.
        measure: what the steps of each number are divided by, squared.
    """

    def __init__(self, values: torch.Tensor, measure: Measure) -> None:
        self.values, self._measure = values, measure
        self._first, self._second, self._steps = torch.zeros_like(values), torch.zeros_like(values), 0

    def step(self, grad: torch.Tensor, rate: float) -> None:
        """Replace ``values``: one step of length ``rate`` against a gradient [K, 6]."""
        self._steps += 1
        self._first = BETAS[0] * self._first + (1 - BETAS[0]) * grad
        self._second = BETAS[1] * self._second + (1 - BETAS[1]) * grad**2
        scale = (self._measure(self._second) / (1 - BETAS[1] ** self._steps)).sqrt() + EPSILON
        self.values = self.values - rate * (self._first / (1 - BETAS[0] ** self._steps)) / scale


def narrow_to(
    work: FitContext, start: GroupTransforms[FloatArray]
) -> tuple[Gaussians[torch.Tensor], GroupTransforms[torch.Tensor]]:
    """Narrow a frame to the rows that move; return them before they move, and their transforms, on its device.

    The transforms are of these rows, which they count from 0 to A - 1.
    """
    device = work.gaussians.means.device
    transforms = start.map(lambda value: torch.from_numpy(value).to(device))
    work.narrow(transforms.rows)
    base = work.gaussians.rows(transforms.rows)
    return base, transforms._replace(rows=torch.arange(len(base), device=device))


def found_transforms(values: torch.Tensor) -> FloatArray:
    """Return fitted shifts and turns [K, 6] as an array. Raises ShapeError where one is not finite."""
    check_finite("shifts and turns of the groups that were fitted", values)
    return np.asarray(values.cpu().numpy())


def fit_transforms_adam(
    work: FitContext,
    start: GroupTransforms[FloatArray],
    unit: FloatArray,
    rates: Sequence[float],
    order: np.random.Generator,
    measure: Measure,
    l1_weight: float = 0.0,
) -> FloatArray:
    """Return the shifts and turns [K, 6] of groups that explain the images best.

    Arguments:
        work: the frame; it is narrowed to the rows that move.
        start: where the fit begins.
        unit: [6] what a rate of 1 means for shift x, y, z [scene units] and turn x, y, z [tan(angle / 2)].
        rates: length of the step of every iteration, in units; their number is that of the iterations.
        order: draws the order of the views, anew for each pass.
        measure: what the steps of each number are divided by, squared.
        l1_weight: weight of the mean absolute value of all numbers, in units, beside the photometric loss.
    """
    views, (base, local) = len(work.cameras), narrow_to(work, start)
    per_step = torch.from_numpy(unit).to(base.means.device)
    descent = GroupAdam(torch.cat([local.translation, local.rotation], 1) / per_step, measure)
    for step, rate in enumerate(rates):
        if step % views == 0:
            sequence = order.permutation(views)
        values = descent.values
        now = values * per_step
        transforms = local._replace(translation=now[:, :3], rotation=now[:, 3:])
        found = work.loss_and_grad(int(sequence[step % views]), WrtTransforms(base, transforms))
        grad = found.grad * per_step
        if l1_weight:
            grad = grad + l1_weight * values.sign() / values.numel()
        descent.step(grad, rate)
    return found_transforms(descent.values * per_step)


def elementwise(second: torch.Tensor) -> torch.Tensor:
    """Return the squared gradients as they are: every number is measured by itself, as Adam does."""
    return second


def groupwise_max(second: torch.Tensor) -> torch.Tensor:
    """Return the squared gradient [K, 1] that all six numbers of a group are divided by: the largest of them.

    With a measure of its own, every number would make steps of full size: also numbers that the images do not determine
    (depth, the turn of a ball), and those of groups that are hardly seen. Such steps are noise, which the residual has
    to mend. A group whose gradient is below the mean of all groups is divided by that mean.
    """
    return second.amax(1, keepdim=True).maximum(second.mean())
