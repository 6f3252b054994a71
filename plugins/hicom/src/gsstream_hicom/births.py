"""Gaussians that a frame adds: copies of those that the images pull at, fitted while the rest holds still."""

from __future__ import annotations

import torch

from gsstream.api import FrameWork, Gaussians, Rng
from gsstream.blocks import DensifyStatistics, fitted_births, joined
from gsstream_hicom.settings import BirthSettings


def added(
    scene: Gaussians[torch.Tensor], work: FrameWork, epochs: int, settings: BirthSettings, rng: Rng
) -> Gaussians[torch.Tensor]:
    """Return the Gaussians that a frame adds to a scene, raw values.

    Arguments:
        scene: N rows, after the frame's motions and without those that leave.
        work: the frame.
        epochs: passes over the training cameras, spread over the rounds.
        settings: of births.
        rng: random streams by name and frame.
    """
    born = scene.rows(slice(0, 0))
    views = list(range(len(work.cameras)))
    for round_ in range(settings.rounds):
        passes = epochs * (round_ + 1) // settings.rounds - epochs * round_ // settings.rounds
        room = settings.most - len(born)
        if not passes or (room <= 0 and not len(born)):
            continue
        inner = work.on(joined(scene, born) if len(born) else scene)
        parents = wanted(inner, settings.gradient)[:room].sort().values
        copies = inner.gaussians.rows(parents)
        born = joined(born, copies) if len(born) else copies
        if not len(born):
            continue
        born = fitted_births(scene, born, work, views, passes, rng)
        born = born.rows(born.opacities.sigmoid() >= settings.prune_opacity)
    return born


def wanted(work: FrameWork, gradient: float) -> torch.Tensor:
    """Return the rows [P] whose mean screen gradient exceeds a bound, in half image widths, the largest first.

    The gradient is that of the mean absolute difference between what a view shows and what its camera recorded.

    Arguments:
        work: the frame, seen from the scene that is searched.
        gradient: the bound, half-width units.
    """
    half = torch.tensor([work.cameras.width / 2, work.cameras.height / 2])
    statistics = DensifyStatistics.zeros(len(work.gaussians))
    for view in range(len(work.cameras)):
        difference = work.previous_render(view) - work.image(view)
        found = work.screen_gradient(view, difference.sign() / difference.numel())
        statistics = statistics.add(found.gradient * half)
    pull = statistics.mean
    hot = (pull > gradient).nonzero()[:, 0]
    return hot[torch.argsort(pull[hot], descending=True, stable=True)]
