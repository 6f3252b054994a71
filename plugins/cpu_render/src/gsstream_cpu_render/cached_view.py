"""One camera's cache and render of a scene, and what all cameras do with theirs at the same time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsstream.api import Gaussians
from gsstream.backend import LossAndGrad, ViewTarget
from gsstream_cpu_render import _native
from gsstream_cpu_render.arrays import (
    Float32,
    SplatArrays,
    as_array,
    lasting_array,
    raise_on_faults,
    refuse_value,
    require_splats,
    splats_of,
)
from gsstream_cpu_render.loss import PreparedImage
from gsstream_cpu_render.native import native_scene
from gsstream_cpu_render.pool import PooledRasterizer

Ids = NDArray[np.uint32]


class CachedView:
    """A camera's cache and its render of the scene as it was when the session opened or last was committed."""

    def __init__(self, held: PooledRasterizer, splats: SplatArrays) -> None:
        self.held, self.rasterizer = held, held.rasterizer
        shape = self.rasterizer.height, self.rasterizer.width, 3
        self.image, _ = self.rasterizer.forward(splats, image=lasting_array(shape, np.float32))
        self._transmittance: Float32 | None = None
        self.rasterizer.forget()
        self.rasterizer.free_scratch()
        self._frozen: tuple[Ids, Any] | None = None
        self.scenes = 0  # how many changes of the scene it has seen

    @property
    def transmittance(self) -> Float32:
        """Share of the background's light that is left [H, W]. Native fits never ask; for others it is kept."""
        if self._transmittance is None:
            self._transmittance = self.rasterizer.forward_cached()[1]
        return self._transmittance

    def thaw(self) -> None:
        """Other rows may change from now on."""
        self._frozen = None

    def freeze(self, ids: Ids, mask: Any) -> None:
        """Let these rows change, in these tiles; does nothing if that is already so."""
        if not self.is_frozen(ids, mask):
            self.rasterizer.freeze(mask, ids)
            self.is_now_frozen(ids, mask)

    def is_frozen(self, ids: Ids, mask: Any) -> bool:
        """Whether these rows may change, in these tiles, and no others."""
        return self._frozen is not None and self._frozen[0] is ids and _same(self._frozen[1], mask)

    def is_now_frozen(self, ids: Ids, mask: Any) -> None:
        """Remember what the rasteriser was frozen to."""
        self._frozen = ids, None if mask is None else mask.copy()

    def loss_and_grad(self, rows: Gaussians[torch.Tensor], target: ViewTarget) -> LossAndGrad[Gaussians[torch.Tensor]]:
        """Render the active rows, compare, differentiate."""
        grad = rows.map(lambda value: torch.empty(value.shape))
        loss = self.rasterizer.loss_and_grad_active(splats_of(rows), *self._compared(target), splats_of(grad))
        return LossAndGrad(torch.tensor(loss, dtype=torch.float64), grad)

    def comparison(self, target: ViewTarget) -> Any:
        """The target that renders of this view are compared with, as the kernels take it."""
        return self.rasterizer.comparison(*self._compared(target))

    def _compared(self, target: ViewTarget) -> tuple[Any, PreparedImage, float, list[Any], Any]:
        prepared: PreparedImage = target.prepared
        weights = None if target.tile_weights is None else as_array("tile_weights", target.tile_weights)
        return self.image, prepared, target.dssim, exposure_arrays(target), weights

    def bytes(self) -> int:
        kept = 0 if self._transmittance is None else self._transmittance.nbytes
        return self.rasterizer.memory_bytes() + self.image.nbytes + kept


def exposure_arrays(target: ViewTarget) -> list[Any]:
    """Matrix and offset of the camera's colour map as the kernels take them; None each without a map."""
    if target.exposure is None:
        return [None, None]
    return [target.exposure.matrix.contiguous().numpy(), target.exposure.offset.contiguous().numpy()]


def freeze_views(views: Sequence[CachedView], ids: Ids) -> None:
    """Let these rows change in all tiles, in all views at the same time."""
    others = [view for view in views if not view.is_frozen(ids, None)]
    if not others:
        return
    try:
        _native.freeze_views([view.rasterizer.handle for view in others], ids)
    except ValueError as error:
        refuse_value(str(error))
    for view in others:
        view.is_now_frozen(ids, None)


def update_views(views: Sequence[CachedView], ids: Ids, rows: SplatArrays, background: Float32) -> None:
    """Bring caches and renders to the scene in which these rows have these values, all views at the same time."""
    if not views:
        return
    rows = require_splats(rows, len(ids))
    for view in views:
        view.scenes += 1
        view.rasterizer.forget()  # afterwards no backward pass of an earlier forward is possible
    targets = [(view.rasterizer.handle, view.image, view._transmittance) for view in views]
    raise_on_faults(_native.update_views(targets, ids, native_scene(rows), background), rows)


def _same(a: Any, b: Any) -> bool:
    return a is b or (a is not None and b is not None and np.array_equal(a, b))
