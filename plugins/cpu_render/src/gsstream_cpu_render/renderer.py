"""The renderer `cpu` of gsstream: the native rasteriser behind torch's autograd. Imports torch, as the engine does."""

from __future__ import annotations

from typing import Any, NamedTuple, final

import numpy as np
import torch
from torch.autograd.function import once_differentiable

from gsstream.api import (
    ATTRIBUTES,
    Cameras,
    Gaussians,
    PartConfig,
    Renderer,
    RenderOutput,
    RenderSession,
    ScreenGradient,
)
from gsstream_cpu_render import _native
from gsstream_cpu_render.arrays import SplatArrays
from gsstream_cpu_render.checks import Float32, as_array
from gsstream_cpu_render.pool import Lease, Passes, lease
from gsstream_cpu_render.rasterizer import NumpyRasterizer
from gsstream_cpu_render.view import Background


@final
class CpuRenderer(Renderer):
    """Fast CPU rasteriser (C++20, SIMD). Float32 only; same semantics as the reference renderer.

    In a session that changes only some rows, projected records and depth-sorted tile lists of all others are cached
    per camera, and only the blocks which active rows touch are rendered and differentiated: image and gradients have
    the same bits as a render of the whole scene.
    """

    class Config(PartConfig):
        """No settings. Threads: gsstream_cpu_render.threads; instruction set: environment GSSTREAM_ISA."""

    def __init__(self, config: PartConfig | None = None) -> None:
        super().__init__(config)
        _native.active_isa()  # a wrong GSSTREAM_ISA is an error here, not in the middle of a run

    def render(
        self, gaussians: Gaussians[torch.Tensor], cameras: Cameras, view: int, background: Background
    ) -> RenderOutput:
        return _differentiable(_FullPass(lease(cameras, view, background), None), gaussians, None)

    def screen_gradient(
        self, gaussians: Gaussians[torch.Tensor], cameras: Cameras, view: int, image_gradient: torch.Tensor
    ) -> ScreenGradient:
        held = lease(cameras, view, (0.0, 0.0, 0.0))
        held.rasterizer.forward(_splats(gaussians))
        return _screen_gradient(held.rasterizer, image_gradient)

    def open(
        self,
        gaussians: Gaussians[torch.Tensor],
        active: torch.Tensor | None,
        cameras: Cameras,
        background: Background,
    ) -> RenderSession:
        return CpuSession(gaussians, active, cameras, background)


@final
class CpuSession(RenderSession):
    """One frame step. Keeps one rasteriser and one cached render per view that was asked for.

    Arguments:
        gaussians: the scene; rows outside `active` are read once per view.
        active: [A] rows that change, any order, no duplicates; None: all.
        cameras, background: the rig and the colour behind everything.
    """

    def __init__(
        self, gaussians: Gaussians[torch.Tensor], active: torch.Tensor | None, cameras: Cameras, background: Background
    ) -> None:
        self._gaussians, self._cameras, self._background = gaussians, cameras, background
        self._views: dict[int, _FrozenView] = {}
        self._opened: dict[int, _OpenedView] = {}
        self._order: torch.Tensor | None = None
        self._ids: np.ndarray[Any, np.dtype[np.uint32]] | None = None
        if active is not None:
            self.narrow(active)

    def narrow(self, active: torch.Tensor) -> None:
        ids, order = torch.sort(active)
        self._ids = ids.numpy().astype(np.uint32)
        # The kernels want ascending rows; callers mostly have them so.
        self._order = None if bool((order[1:] > order[:-1]).all()) else order

    def screen_gradient(self, view: int, image_gradient: torch.Tensor) -> ScreenGradient:
        if view not in self._opened:
            self._opened[view] = self._open(view)
        return _screen_gradient(self._opened[view].held.rasterizer, image_gradient)

    def _open(self, view: int) -> _OpenedView:
        held = lease(self._cameras, view, self._background)
        return _OpenedView(held, *held.rasterizer.forward(_splats(self._gaussians)))

    def render(
        self,
        view: int,
        rows: Gaussians[torch.Tensor],
        *,
        probe: torch.Tensor | None = None,
        tile_mask: torch.Tensor | None = None,
    ) -> RenderOutput:
        mask = None if tile_mask is None else as_array("tile_mask", tile_mask)
        if self._ids is None:
            return _differentiable(_FullPass(lease(self._cameras, view, self._background), mask), rows, probe)
        if view not in self._views:
            opened = self._opened.pop(view, None) or self._open(view)
            self._views[view] = _FrozenView(opened, self._ids)
        if self._order is not None:
            rows = rows.rows(self._order)
            probe = None if probe is None else probe[self._order]
        return _differentiable(_ActivePass(self._views[view], mask), rows, probe)


class _FullPass(Passes):
    """Forward and backward of a whole scene with a rasteriser of its own."""

    def __init__(self, held: Lease, mask: Any) -> None:
        self._held, self._mask = held, mask

    def forward(self, splats: SplatArrays) -> tuple[Float32, Float32]:
        return self._held.rasterizer.forward(splats, tile_mask=self._mask)

    def backward(self, splats: SplatArrays, v_image: Float32, v_alpha: Float32 | None) -> tuple[Float32, ...]:
        return self._held.rasterizer.backward(v_image, v_alpha)


class _OpenedView(NamedTuple):
    """A rasteriser that has just rendered the whole scene, and what it rendered."""

    held: Lease
    image: Float32
    transmittance: Float32


class _FrozenView:
    """A camera's cache and its render of the scene as it was when the session opened."""

    def __init__(self, opened: _OpenedView, ids: np.ndarray[Any, np.dtype[np.uint32]]) -> None:
        self._held, self.image, self.transmittance = opened
        self.rasterizer, self._ids = self._held.rasterizer, ids
        self._mask: Any = None
        self.rasterizer.forget()
        self.rasterizer.freeze(None, ids)

    def limit(self, mask: Any) -> None:
        """Freeze again if the tiles differ from those of the last pass."""
        same = mask is self._mask or (mask is not None and self._mask is not None and np.array_equal(mask, self._mask))
        if not same:
            self.rasterizer.freeze(mask, self._ids)
            self._mask = None if mask is None else mask.copy()


class _ActivePass(Passes):
    """Forward and backward of the active rows over a view's cache, which it shares with other passes."""

    def __init__(self, view: _FrozenView, mask: Any) -> None:
        self._view, self._mask = view, mask
        self._pass = -1

    def forward(self, splats: SplatArrays) -> tuple[Float32, Float32]:
        self._view.limit(self._mask)
        image, transmittance = self._view.image.copy(), self._view.transmittance.copy()
        rasterizer = self._view.rasterizer
        rasterizer.forward_active(splats, image=image, transmittance=transmittance, touched_only=True)
        self._pass = rasterizer.passes
        return image, transmittance

    def backward(self, splats: SplatArrays, v_image: Float32, v_alpha: Float32 | None) -> tuple[Float32, ...]:
        if self._view.rasterizer.passes != self._pass:
            self.forward(splats)  # the view was rendered again since; the same inputs give the same bits
        return self._view.rasterizer.backward_active(v_image, v_alpha)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, passes: Passes, _probe: torch.Tensor | None, *attributes: torch.Tensor) -> Any:
        image, transmittance = passes.forward(_splats(Gaussians(*attributes)))
        ctx.passes = passes
        ctx.save_for_backward(*attributes)
        ctx.set_materialize_grads(False)
        return torch.from_numpy(image), torch.from_numpy(1.0 - transmittance)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_image: torch.Tensor | None, v_alpha: torch.Tensor | None) -> Any:
        splats = _splats(Gaussians(*ctx.saved_tensors))  # also proves that nobody changed them since
        if v_image is None and v_alpha is None:
            return (None,) * (2 + len(ATTRIBUTES))
        if v_image is None and v_alpha is not None:
            v_image = torch.zeros(*v_alpha.shape, 3)
        assert v_image is not None
        upstream = None if v_alpha is None else as_array("gradient of alpha", v_alpha.contiguous())
        gradients = ctx.passes.backward(splats, as_array("gradient of the image", v_image.contiguous()), upstream)
        *attributes, means2d = (torch.from_numpy(g) for g in gradients)
        return None, (means2d if ctx.needs_input_grad[1] else None), *attributes


def _screen_gradient(rasterizer: NumpyRasterizer, image_gradient: torch.Tensor) -> ScreenGradient:
    """Of the scene the rasteriser rendered last."""
    gradient = rasterizer.backward_screen(as_array("image_gradient", image_gradient.contiguous()))
    visible = torch.zeros(len(gradient), dtype=torch.bool)
    visible[torch.from_numpy(rasterizer.visible_rows().astype(np.int64))] = True
    return ScreenGradient(torch.from_numpy(gradient), visible)


def _differentiable(passes: Passes, gaussians: Gaussians[torch.Tensor], probe: torch.Tensor | None) -> RenderOutput:
    attributes = [value for _, value in gaussians.items()]
    image, alpha = _Rasterize.apply(passes, probe, *attributes)  # type: ignore[no-untyped-call]
    return RenderOutput(image, alpha)


def _splats(gaussians: Gaussians[torch.Tensor]) -> SplatArrays:
    """Views of the tensors (copies only where a tensor is not contiguous)."""
    return SplatArrays(*(as_array(name, value.contiguous()) for name, value in gaussians.items()))
