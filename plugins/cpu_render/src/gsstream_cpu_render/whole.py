"""A view of a scene of which every row moves: rendered, compared and differentiated in one native call."""

from __future__ import annotations

import numpy as np
import torch

from gsstream.api import Gaussians
from gsstream.backend import LossAndGrad, ViewTarget, WrtScene
from gsstream_cpu_render.arrays import splats_of
from gsstream_cpu_render.cached_view import exposure_arrays
from gsstream_cpu_render.pool import PooledRasterizer


def loss_and_grad_of_scene(
    held: PooledRasterizer, target: ViewTarget, wrt: WrtScene
) -> LossAndGrad[Gaussians[torch.Tensor]]:
    """Return loss and gradients by the rows of a whole scene."""
    rows = wrt.placed().map(torch.Tensor.detach)
    grad = rows.map(lambda value: torch.empty(value.shape))
    means2d = torch.empty(len(rows), 2)
    by_exposure = None if target.exposure is None else np.empty(12, np.float32)
    out = (*splats_of(grad), means2d.numpy())
    loss = held.rasterizer.full_loss_and_grad(
        splats_of(rows),
        target.prepared,
        target.dssim,
        colours=exposure_arrays(target),
        out=out,
        exposure_grad=by_exposure,
    )
    return LossAndGrad(
        torch.tensor(loss, dtype=torch.float64),
        grad,
        means2d=means2d if wrt.means2d else None,
        exposure=torch.from_numpy(by_exposure) if by_exposure is not None and wrt.exposure else None,
    )
