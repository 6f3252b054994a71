"""A view of a scene of which every row moves: rendered, compared and differentiated in one native call."""

from __future__ import annotations

import numpy as np
import torch

from gsstream.api import Comparison, Gaussians, WholePull
from gsstream_cpu_render.autograd import splats_of
from gsstream_cpu_render.pool import Lease


def whole_pull(held: Lease, rows: Gaussians[torch.Tensor], comparison: Comparison) -> WholePull:
    """Return what ``gsstream.api.RenderSession.pull_whole`` does.

    Arguments:
        held: a rasteriser of the camera.
        rows: all N rows of the scene.
        comparison: what the render is compared with, by the native loss; all tiles count.
    """
    splats = splats_of(rows.map(torch.Tensor.detach))
    gradients = rows.map(lambda value: torch.empty(value.shape))
    means2d = torch.empty(len(rows), 2)
    matrix, offset = (None if value is None else value.contiguous().numpy() for value in
                      (comparison.matrix, comparison.offset))  # fmt: skip
    colours = None if matrix is None else np.empty(12, np.float32)
    out = (*splats_of(gradients), means2d.numpy())
    loss = held.rasterizer.pull_whole(splats, comparison.target, comparison.dssim, (matrix, offset), out, colours)
    return WholePull(loss, gradients, means2d, None if colours is None else torch.from_numpy(colours))
