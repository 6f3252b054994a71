"""Render sessions: what stays the same from one iteration to the next, and from one frame to the next, is kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, final

import numpy as np
import torch
from numpy.typing import NDArray

from gsstream.api import Cameras, Gaussians, InputError, WrtRows, WrtTransforms
from gsstream.backend import (
    G,
    LossAndGrad,
    RenderCache,
    RenderOutput,
    RenderSession,
    RowGradient,
    ScreenGradient,
    ViewTarget,
    Wrt,
    WrtScene,
    check_tiles,
)
from gsstream_cpu_render import _native
from gsstream_cpu_render.arrays import Float32, SplatArrays, as_array, splats_of
from gsstream_cpu_render.autograd import differentiable
from gsstream_cpu_render.cached_view import CachedView, Ids, freeze_views, update_views
from gsstream_cpu_render.moved import loss_and_grad_of_transforms
from gsstream_cpu_render.pool import Passes, PooledRasterizer, acquire_rasterizer
from gsstream_cpu_render.view import Background
from gsstream_cpu_render.whole import loss_and_grad_of_scene


@final
class CpuSession(RenderSession):
    """Keeps one rasteriser and one render per view that was asked for, while the budget lasts.

    A view beyond the budget fills its cache anew for each call: same bits, but its cost grows with the scene.

    Arguments:
        gaussians: the scene; rows outside `active` are read once per view.
        active: [A] rows that change, any order, no duplicates; None: all.
        cameras, background: the rig and the colour behind everything.
        budget: bytes that the caches of all views may take together; None: no limit.
    """

    def __init__(
        self,
        gaussians: Gaussians[torch.Tensor],
        active: torch.Tensor | None,
        cameras: Cameras,
        background: Background,
        budget: int | None = None,
    ) -> None:
        self._gaussians, self._cameras, self._background, self._budget = gaussians, cameras, background, budget
        self._views: dict[int, CachedView] = {}
        self._refused: set[int] = set()  # views that do not fit into the budget
        self._order: torch.Tensor | None = None
        self._ids: Ids | None = None
        if active is not None:
            self.narrow(active)

    @property
    def cameras(self) -> Cameras:
        return self._cameras

    def narrow(self, active: torch.Tensor) -> None:
        self._ids, self._order = _ascending(active)
        for view in self._views.values():
            view.thaw()

    def screen_gradient(self, view: int, image_gradient: torch.Tensor) -> ScreenGradient:
        upstream = as_array("image_gradient", image_gradient.contiguous())
        splats = splats_of(self._gaussians)
        cached = self._view(view)  # keeps the rasteriser alive while the native call runs
        gradient, visible = cached.rasterizer.backward_cached(splats, upstream)
        return ScreenGradient(torch.from_numpy(gradient), torch.from_numpy(visible))

    def screen_gradient_rows(self, view: int, image_gradient: torch.Tensor) -> RowGradient:
        upstream = as_array("image_gradient", image_gradient.contiguous())
        splats = splats_of(self._gaussians)
        cached = self._view(view)  # keeps the rasteriser alive while the native call runs
        rows, gradient = cached.rasterizer.backward_cached_rows(splats, upstream)
        return RowGradient(torch.from_numpy(rows), torch.from_numpy(gradient))

    def visible(self, view: int, tiles: torch.Tensor) -> torch.Tensor:
        check_tiles(tiles, (self._cameras.height, self._cameras.width))
        if not bool(tiles.any()):
            return torch.zeros(len(self._gaussians), dtype=torch.bool)
        cached = self._view(view)  # keeps the rasteriser alive while the native call runs
        return torch.from_numpy(cached.rasterizer.contributing_in_cache(as_array("tiles", tiles)))

    def visible_anywhere(self, tiles: torch.Tensor) -> torch.Tensor:
        views = tiles.flatten(1).any(1).nonzero()[:, 0].tolist()
        for view in views:
            check_tiles(tiles[view], (self._cameras.height, self._cameras.width))
            if not self._refused:
                self._view(view)
        if any(view not in self._views for view in views):
            return super().visible_anywhere(tiles)  # caches beyond the budget are filled one at a time
        drawn = np.zeros(len(self._gaussians), np.uint8)
        if views:
            masks = as_array("tiles", tiles.contiguous()).view(np.uint8)
            _native.drawn_in_views([(self._views[view].rasterizer.handle, masks[view]) for view in views], drawn)
        return torch.from_numpy(drawn.view(np.bool_))

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
            return differentiable(FullPass(self._lease(view), mask), rows, probe)
        if self._order is not None:
            rows = rows.rows(self._order)
            probe = None if probe is None else probe[self._order]
        active = _ActivePass(self._view(view), self._ids, mask)
        output = differentiable(active, rows, probe)
        return replace(output, tiles=torch.from_numpy(active.tiles))

    def loss_and_grad(self, view: int, target: ViewTarget, wrt: Wrt[G]) -> LossAndGrad[G]:
        found: LossAndGrad[Any] | None = None
        if self._order is None:
            narrowed = self._ids is not None
            match wrt:
                case WrtRows(means2d=False) if narrowed:
                    found = self._by_rows(view, target, wrt)
                case WrtTransforms() if narrowed:
                    found = self._by_transforms(view, target, wrt)
                case WrtScene() if not narrowed and target.tile_weights is None:
                    found = loss_and_grad_of_scene(self._lease(view), target, wrt)
                case _:
                    pass
        return super().loss_and_grad(view, target, wrt) if found is None else found

    def _by_rows(self, view: int, target: ViewTarget, wrt: WrtRows) -> LossAndGrad[Gaussians[torch.Tensor]]:
        cached = self._view(view)  # keeps the rasteriser alive while the native call runs
        assert self._ids is not None
        cached.freeze(self._ids, None)
        return cached.loss_and_grad(wrt.values, target)

    def _by_transforms(self, view: int, target: ViewTarget, wrt: WrtTransforms) -> LossAndGrad[torch.Tensor] | None:
        """None where there is a fault, which the default body finds words for, or the cache is beyond the budget."""
        ready = self.fused_views([view], [target])
        return None if ready is None else loss_and_grad_of_transforms(*ready[0], target, wrt)

    def fused_views(self, views: Sequence[int], targets: Sequence[ViewTarget]) -> list[tuple[Any, Any]] | None:
        """The native rasterisers of these views, frozen to the active rows, and what they are compared with.

        None where iterations have to be made one by one: rows in no order, a wide session, in which nothing stands
        still that could be left out, or caches that do not all fit into the budget.
        """
        if self._ids is None or self._order is not None:
            return None
        cached = [self._view(view) for view in views]
        freeze_views(cached, self._ids)
        pairs = zip(cached, targets, strict=True)
        ready = [(view.rasterizer.handle, view.comparison(target)) for view, target in pairs]
        return ready if all(view in self._views for view in views) else None

    def commit(self, gaussians: Gaussians[torch.Tensor], changed: torch.Tensor) -> RenderSession:
        if len(gaussians) != len(self._gaussians):
            raise InputError(
                f"gaussians: expected the {len(self._gaussians)} rows of the session, got {len(gaussians)}; "
                "open a new session when rows are added or removed"
            )
        ids, order = _ascending(changed)
        after = CpuSession(
            gaussians=gaussians, active=None, cameras=self._cameras, background=self._background, budget=self._budget
        )
        after._refused = self._refused
        views, self._views = self._views, {}
        if len(ids):
            rows = gaussians.rows(changed if order is None else changed[order])
            update_views(list(views.values()), ids, splats_of(rows), np.asarray(self._background, np.float32))
        for view in views.values():
            view.thaw()
        after._views = views
        return after

    def cache_bytes(self) -> RenderCache:
        return RenderCache({index: view.bytes() for index, view in self._views.items()}, len(self._gaussians))

    def _lease(self, view: int, own: bool = False) -> PooledRasterizer:
        return acquire_rasterizer(self._cameras, view, self._background, own)

    def _view(self, view: int) -> CachedView:
        """A view with its cache filled, kept for the next call unless the caches together are beyond the budget."""
        cached = self._views.get(view)
        if cached is None:
            kept = view not in self._refused
            # Where memory is limited, a rasteriser of its own: one of the pool has as much memory as its former users
            # needed.
            held = self._lease(view, own=kept and self._budget is not None)
            cached = CachedView(held, splats_of(self._gaussians))
            if kept:
                self._views[view] = cached
        # The working memory of a view grows with its passes, so a view that fitted into the budget at first may not
        # later.
        if self._budget is not None and view in self._views and self.cache_bytes().total > self._budget:
            self._refused.add(view)
            del self._views[view]
        return cached


def _ascending(rows: torch.Tensor) -> tuple[Ids, torch.Tensor | None]:
    """Rows in ascending order as the kernels want them, and the order to put values in (None: they are in order)."""
    ids, order = torch.sort(rows)
    in_order = bool((order[1:] > order[:-1]).all())
    return ids.numpy().astype(np.uint32), None if in_order else order


class FullPass(Passes):
    """Forward and backward of a whole scene with a rasteriser of its own."""

    def __init__(self, held: PooledRasterizer, mask: Any) -> None:
        self._held, self._mask = held, mask

    def forward(self, splats: SplatArrays) -> tuple[Float32, Float32]:
        return self._held.rasterizer.forward(splats, tile_mask=self._mask)

    def backward(self, splats: SplatArrays, v_image: Float32, v_alpha: Float32 | None) -> tuple[Float32, ...]:
        return self._held.rasterizer.backward(v_image, v_alpha)


class _ActivePass(Passes):
    """Forward and backward of the active rows over a view's cache, which it shares with other passes."""

    def __init__(self, view: CachedView, ids: Ids, mask: Any) -> None:
        self._view, self._ids, self._mask = view, ids, mask
        self._pass, self._scene = -1, view.scenes
        self.tiles: NDArray[np.bool_] = np.zeros((0, 0), np.bool_)  # known after a forward

    def forward(self, splats: SplatArrays) -> tuple[Float32, Float32]:
        if self._scene != self._view.scenes:
            raise InputError(
                "backward: expected the session that rendered, got one whose changes were committed since; "
                "differentiate before the commit"
            )
        self._view.freeze(self._ids, self._mask)
        image, transmittance = self._view.image.copy(), self._view.transmittance.copy()
        rasterizer = self._view.rasterizer
        rasterizer.forward_active(splats, image=image, transmittance=transmittance, touched_only=True)
        self._pass, self.tiles = rasterizer.passes, rasterizer.touched_tiles()
        return image, transmittance

    def backward(self, splats: SplatArrays, v_image: Float32, v_alpha: Float32 | None) -> tuple[Float32, ...]:
        if self._view.rasterizer.passes != self._pass:
            self.forward(splats)  # the view was rendered again; the same inputs give the same bits
        return self._view.rasterizer.backward_active(v_image, v_alpha)
