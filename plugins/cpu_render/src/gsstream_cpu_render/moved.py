"""Loss and gradient by the transforms of groups of rows, in one native call."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from gsstream.api import WrtTransforms
from gsstream.backend import LossAndGrad, ViewTarget
from gsstream_cpu_render import _native
from gsstream_cpu_render.arrays import splats_of
from gsstream_cpu_render.loss import weighted
from gsstream_cpu_render.native import native_scene


def loss_and_grad_of_transforms(
    rasterizer: Any, compared: Any, target: ViewTarget, wrt: WrtTransforms
) -> LossAndGrad[torch.Tensor] | None:
    """Return loss, gradient and curvature; None where there is a fault."""
    transforms = wrt.transforms.map(torch.Tensor.numpy)
    groups = len(transforms.center)
    grad, curvature = np.empty((groups, 6)), np.empty((groups, 6, 6)) if wrt.curvature else None
    group = np.ascontiguousarray(transforms.group, np.int64)
    parts = transforms.center, transforms.translation, transforms.rotation
    arrays = [np.ascontiguousarray(part, np.float64) for part in parts]
    given = rasterizer, native_scene(splats_of(wrt.base)), compared, group, *arrays, grad, curvature
    faults, l1, dssim = _native.transform_loss_and_grad(*given)
    values = target.prepared.image.size
    loss = weighted(l1, dssim, target.dssim, 1.0 / values)
    if faults or not np.isfinite(loss):
        return None
    curved = None if curvature is None else torch.from_numpy(curvature / values)
    return LossAndGrad(torch.tensor(loss, dtype=torch.float64), torch.from_numpy(grad), curved)
