"""Fitting the transforms of groups to the images by damped Gauss-Newton steps, one view at a time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
import torch

from gsstream.core.changes.motion import GroupTransforms
from gsstream.core.shapes import FloatArray
from gsstream.parts.motion.bodies import Bodies, form_bodies
from gsstream.parts.motion.fitting import found_transforms, narrow_to
from gsstream.parts.render.work import FitContext
from gsstream.parts.render.wrt import LossAndGrad, WrtTransforms

#: Pixels that a prediction must move some group for shares of it to be compared, and views that they are compared in.
FAR, LOOKS = 1.0, 2


class Damping(NamedTuple):
    """Levenberg-Marquardt damping, which shortens steps where the curvature is small."""

    relative: float  # share of the group's mean curvature, or of the mean over all groups if larger, on the diagonal
    absolute: float  # curvature added to the diagonal besides: summed over the values of an image, per pixel^2
    max_step: float  # largest change of any of the six numbers in one step, pixels


class BodySettings(NamedTuple):
    """When neighbouring groups are joined to bodies, and how strongly a body holds its groups."""

    most: float  # loss that joining a pair may cost, summed over the values of all images; 0: no bodies
    #: Curvature of the pull of a group towards the motion of its body, per pixel^2, summed over values of all images.
    hold: float


class DampedNewton:
    """Descends along the gradient of one view after another, divided by the summed curvature of the views so far.

    Because the sum grows, later views take shorter steps: after an epoch all views have the same weight (recursive
    least squares). Later epochs reuse the mean curvature of the first.
    """

    def __init__(self, values: torch.Tensor, damping: Damping) -> None:
        self.values, self._damping = values, damping
        self._total, self._measured, self._seen = values.new_zeros(len(values), 6, 6), 0, 0
        self._identity = torch.eye(6, dtype=values.dtype, device=values.device)
        self._held: _HeldGroups | None = None

    def step(self, grad: torch.Tensor, curvature: torch.Tensor | None = None) -> None:
        """Replace ``values``: one step against the gradient [K, 6] of a view."""
        self._seen += 1
        if curvature is not None:
            self._total += curvature
            self._measured += 1
        matrix = self._damped_curvature()
        if self._held is not None:
            self.values = self.values - self._held.step(grad, matrix, self._seen, self._damping.max_step)
            return
        # The variant that does not look at its result: to look, a GPU is waited for. What is damped has a solution.
        step = torch.linalg.solve_ex(matrix, grad[..., None]).result[..., 0]
        self.values = self.values - step * _shortening(step.abs().amax(1, keepdim=True), self._damping.max_step)

    def join_neighbours(self, center: FloatArray, unit: FloatArray, settings: BodySettings) -> None:
        """Join groups to bodies (:func:`form_bodies`), which hold them in later steps; call it after the first epoch.

        The motions of groups in a body are smoothed. The steps of later views become long again: the groups have moved,
        so the curvature of earlier views belongs to another place.
        """
        matrix = self._damped_curvature()
        bodies = form_bodies(
            center, unit, self.values.cpu().numpy(), curvature=matrix.cpu().numpy(), most=settings.most
        )
        there = torch.from_numpy(bodies.values).to(matrix.device)
        away = matrix @ (self.values - there)[..., None]
        away = torch.linalg.solve_ex(matrix + settings.hold * self._identity, away).result[..., 0]
        self.values = there + away
        self._held = _HeldGroups(bodies, away, settings.hold / self._measured)
        self._seen = 1

    def _damped_curvature(self) -> torch.Tensor:
        """[K, 6, 6] of the views so far."""
        matrix = self._total * (self._seen / self._measured)
        mean = matrix.diagonal(dim1=1, dim2=2).sum(1) / 6
        added = self._damping.relative * mean.maximum(mean.mean()) + self._damping.absolute
        return matrix + added[:, None, None] * self._identity


class _HeldGroups:
    """Groups that springs hold to their bodies: spring * |away|^2 / 2 is added to the loss of every view.

    Arguments:
        bodies: the bodies.
        away: [K, 6] how far each group is from where its body takes it.
        spring: curvature per view.
    """

    def __init__(self, bodies: Bodies, away: torch.Tensor, spring: float) -> None:
        self._body = torch.from_numpy(bodies.body).to(away.device)
        self._lever = torch.from_numpy(bodies.lever).to(away.device)
        self._number, self._away, self._spring = int(bodies.body.max()) + 1, away, spring
        self._identity = torch.eye(6, dtype=away.dtype, device=away.device)

    def step(self, grad: torch.Tensor, matrix: torch.Tensor, seen: int, max_step: float) -> torch.Tensor:
        """Return [K, 6] what is taken from the values, against the gradient [K, 6] of a view.

        Arguments:
            matrix: [K, 6, 6] curvature of the ``seen`` views so far, this one among them.
            max_step: no number of a group changes by more; all groups of its body stay behind in proportion.
        """
        # The minimum over groups and bodies together: the groups are eliminated first, each by its own 6 x 6 matrix.
        spring, identity = self._spring * seen, self._identity
        inverse = torch.linalg.inv_ex(matrix + spring * identity).inverse
        alone = inverse @ (grad + self._spring * self._away)[..., None]
        force = self._by_body(self._lever.mT @ (spring * alone - self._spring * self._away[..., None]))
        stiff = self._by_body(self._lever.mT @ (spring * (identity - spring * inverse)) @ self._lever)
        along = self._lever @ torch.linalg.solve_ex(stiff, force).result[self._body]
        step, along = (alone + spring * inverse @ along)[..., 0], along[..., 0]
        longest = step.new_zeros(self._number).scatter_reduce_(0, self._body, step.abs().amax(1), "amax")
        shortening = _shortening(longest[self._body][:, None], max_step)
        self._away = self._away - (step - along) * shortening
        taken: torch.Tensor = step * shortening
        return taken

    def _by_body(self, values: torch.Tensor) -> torch.Tensor:
        """[B, ...] sum over the groups of every body."""
        return values.new_zeros(self._number, *values.shape[1:]).index_add_(0, self._body, values)


def _shortening(longest: torch.Tensor, most: float) -> torch.Tensor:
    """Factor on steps whose largest number is ``longest``, so that it is at most ``most``."""
    return (most / longest.clamp_min(1e-12)).clamp_max(1.0)


def fit_transforms_newton(
    work: FitContext,
    start: GroupTransforms[FloatArray],
    unit: FloatArray,
    iterations: int,
    order: np.random.Generator,
    damping: Damping,
    settings: BodySettings,
) -> FloatArray:
    """Return the translations and rotations [K, 6] of groups that minimise the loss where the images changed."""
    views, values = len(work.cameras), 3 * work.cameras.height * work.cameras.width
    base, local = narrow_to(work, start)
    per_step = torch.from_numpy(unit).to(base.means.device)
    squares = torch.outer(per_step, per_step)

    def compared(numbers: torch.Tensor, view: int, curvature: bool = False) -> LossAndGrad[torch.Tensor]:
        now = numbers * per_step
        moved = local._replace(translation=now[:, :3], rotation=now[:, 3:])
        return work.loss_and_grad(view, WrtTransforms(base, moved, curvature), "changed")

    begin = torch.cat([local.translation, local.rotation], 1) / per_step
    if max(np.abs(start.translation).max() / unit[0], np.abs(start.rotation).max() / unit[3]) > FAR:
        begin = begin * share_of_prediction(begin, compared, range(0, views, -(-views // LOOKS)))
    descent = DampedNewton(begin, damping)
    for step in range(iterations):
        if step % views == 0:
            sequence = order.permutation(views)
        if step == views and settings.most:
            descent.join_neighbours(start.center, unit, settings)
        found = compared(descent.values, int(sequence[step % views]), curvature=step < views)
        descent.step(
            found.grad * per_step * values,
            None if found.curvature is None else found.curvature * squares * values,
        )
    return found_transforms(descent.values * per_step)


def share_of_prediction(
    predicted: torch.Tensor, compared: Callable[[torch.Tensor, int], LossAndGrad[torch.Tensor]], views: Iterable[int]
) -> float:
    """Return how much of a predicted motion [K, 6] explains some views best: all of it, nothing, or the way back.

    Where a body stops or turns back, the fit would begin once or twice its way off, which is farther than it comes, and
    what is lost so is not found again: the next frame's prediction is of the wrong motion.

    Arguments:
        predicted: shift and turn of every group, pixels.
        compared: what a motion and the number of a view come to.
        views: numbers of the views.
    """
    best, least = 1.0, math.inf
    for share in (1.0, 0.0, -1.0):
        if (loss := float(sum(compared(share * predicted, view).loss for view in views))) >= least:
            break  # the farther from it, the worse
        best, least = share, loss
    return best
