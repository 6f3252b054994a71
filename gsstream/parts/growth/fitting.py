"""Fitting newborn Gaussians to the images before they are sent."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar, cast

import numpy as np
import torch

from gsstream.core.gaussians import Gaussians
from gsstream.core.rng import Rng
from gsstream.core.shapes import FloatArray
from gsstream.parts.render.work import FitContext
from gsstream.parts.render.wrt import WrtRows

Array = TypeVar("Array", torch.Tensor, FloatArray)
#: Learning rates, those of 3DGS at the start of training; the rate of positions is in standard deviations of each
#: Gaussian.
RATES = {"means": 0.1, "quats": 1e-2, "scales": 0.02, "opacities": 0.1, "sh0": 0.02, "shN": 1e-3}
BETAS, EPSILON = (0.9, 0.99), 1e-15


def concat_gaussians(scene: Gaussians[Array], added: Gaussians[Array]) -> Gaussians[Array]:
    """Return the rows of both, those of ``added`` behind those of ``scene``."""
    values = {}
    for name, value in scene.items():
        both = (value, getattr(added, name))
        values[name] = torch.cat(both) if isinstance(value, torch.Tensor) else np.concatenate(both)
    return cast("Gaussians[Array]", Gaussians(**values))


def fit_added(
    scene: Gaussians[torch.Tensor],
    added: Gaussians[torch.Tensor],
    work: FitContext,
    views: Sequence[int],
    epochs: int,
    rng: Rng,
) -> Gaussians[torch.Tensor]:
    """Return the newborn, optimised in these views while the scene holds still.

    Arguments:
        scene: N rows, raw values, as they are without what the newborn replace.
        added: B rows, raw values.
        work: the frame.
        views: training cameras to fit to.
        epochs: passes over them.
        rng: random streams; decides the order of views.
    """
    inner = work.on(concat_gaussians(scene, added))
    inner.narrow(torch.arange(len(scene), len(scene) + len(added), device=added.means.device))
    values = {name: value.clone() for name, value in added.items()}
    first = {name: torch.zeros_like(value) for name, value in values.items()}
    second = {name: torch.zeros_like(value) for name, value in values.items()}
    size = added.scales.exp().mean(1, keepdim=True)
    order, step = rng.numpy("growth/order", work.index), 0
    for _ in range(epochs):
        for place in order.permutation(len(views)):
            step += 1
            found = inner.loss_and_grad(views[place], WrtRows(Gaussians(**values)))
            for name, grad in found.grad.items():
                first[name] = BETAS[0] * first[name] + (1 - BETAS[0]) * grad
                second[name] = BETAS[1] * second[name] + (1 - BETAS[1]) * grad.square()
                way = first[name] / (1 - BETAS[0] ** step)
                way = way / ((second[name] / (1 - BETAS[1] ** step)).sqrt() + EPSILON)
                values[name] = values[name] - RATES[name] * (way * size if name == "means" else way)
    return Gaussians(**values)
