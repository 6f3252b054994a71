"""Fitting the transforms of groups to the images, one view at a time, with Adam's moments."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
import torch

from gsstream.core.changes import Scene
from gsstream.core.changes.motion import GroupTransforms
from gsstream.core.shapes import FloatArray
from gsstream.parts.render.work import FitContext
from gsstream.parts.render.wrt import WrtTransforms

BETAS, EPSILON = (0.9, 0.99), 1e-12
#: Squared gradients [K, 6] -> by what every number's gradient is divided, squared.
Measure = Callable[[FloatArray], FloatArray]


class GroupAdam:
    """Descends along gradients with Adam's moments, in steps of given length.

    Arguments:
        values: [K, 6] where it begins.
        measure: what the steps of each number are divided by, squared.
    """

    def __init__(self, values: FloatArray, measure: Measure) -> None:
        self.values, self._measure = values, measure
        self._first, self._second, self._steps = np.zeros_like(values), np.zeros_like(values), 0

    def step(self, grad: FloatArray, rate: float) -> None:
        """Replace ``values``: one step of length ``rate`` against a gradient [K, 6]."""
        self._steps += 1
        self._first = BETAS[0] * self._first + (1 - BETAS[0]) * grad
        self._second = BETAS[1] * self._second + (1 - BETAS[1]) * grad**2
        scale = np.sqrt(self._measure(self._second) / (1 - BETAS[1] ** self._steps)) + EPSILON
        self.values = self.values - rate * (self._first / (1 - BETAS[0] ** self._steps)) / scale


def fit_transforms_adam(
    scene: Scene, work: FitContext, start: GroupTransforms, unit: FloatArray, rates: Sequence[float],
    order: np.random.Generator, measure: Measure, l1_weight: float = 0.0, tiles: Literal["all", "changed"] = "all",
) -> FloatArray:  # fmt: skip
    """Return the shifts and turns [K, 6] of groups that explain the images best.

    Arguments:
        scene: decoded, as both ends have it.
        work: the frame, seen from this scene; it is narrowed to the rows that move.
        start: where the fit begins.
        unit: [6] what a rate of 1 means for shift x, y, z [scene units] and turn x, y, z [tan(angle / 2)].
        rates: length of the step of every iteration, in units; their number is that of the iterations.
        order: draws the order of the views, anew for each pass.
        measure: what the steps of each number are divided by, squared.
        l1_weight: weight of the mean absolute value of all numbers, in units, beside the photometric loss.
        tiles: "changed" compares only in tiles that changed and in those beside them.
    """
    views = len(work.cameras)
    work.narrow(torch.from_numpy(start.rows))
    base = scene.gaussians.rows(start.rows).map(torch.from_numpy)
    local = start._replace(rows=np.arange(len(start.rows)))
    descent = GroupAdam(np.concatenate([start.translation, start.rotation], 1) / unit, measure)
    for step, rate in enumerate(rates):
        if step % views == 0:
            sequence = order.permutation(views)
        values = descent.values
        transforms = local._replace(translation=values[:, :3] * unit[:3], rotation=values[:, 3:] * unit[3:])
        found = work.loss_and_grad(int(sequence[step % views]), WrtTransforms(base, transforms), tiles)
        grad = found.grad.numpy() * unit
        if l1_weight:
            grad = grad + l1_weight * np.sign(values) / values.size
        descent.step(grad, rate)
    return np.asarray(descent.values * unit)


def elementwise(second: FloatArray) -> FloatArray:
    """Return the squared gradients as they are: every number is measured by itself, as Adam does."""
    return second


def groupwise_max(second: FloatArray) -> FloatArray:
    """Return the squared gradient [K, 1] that all six numbers of a group are divided by: the largest of them.

    With a measure of its own every number would make steps of full size, those that the images say nothing about too
    (depth, the turn of a ball), and so would groups that are hardly seen: noise, which the residual has to mend. A
    group whose gradient is below the mean of all groups is divided by that mean.
    """
    return np.asarray(np.maximum(second.max(1, keepdims=True), second.mean()))
