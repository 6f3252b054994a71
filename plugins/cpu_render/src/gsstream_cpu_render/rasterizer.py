"""The fast rasteriser on numpy arrays: for the torch-free player and as the floor under CpuRenderer.

Semantics (those of gsstream's reference renderer): near plane, 0.3 px^2 blur, alpha cut at 1/255 and clamped at
0.999, a Gaussian counts while the transmittance before it exceeds 1e-4, Jacobian limited to 1.3 fields of view, colour
max(0, 0.5 + harmonics). Results are bit-identical for any number of threads. After EWA splatting
(Zwicker et al. 2001) and 3D Gaussian Splatting (Kerbl et al. 2023); derivation of the tile test in the C++ files.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsstream_cpu_render.arrays import (
    MASK_TILE,
    Float32,
    SplatArrays,
    SplatGradients,
    native_array,
    raise_on_faults,
    refuse,
    require_mask,
    require_splats,
)
from gsstream_cpu_render.by_parts import draw_by_parts
from gsstream_cpu_render.native import NativeRasterizer, native_scene
from gsstream_cpu_render.view import NEAR, Background


def render_numpy(
    arrays: Sequence[Float32],
    viewmat: ArrayLike,
    K: ArrayLike,
    width: int,
    height: int,
    background: Background = (0.0, 0.0, 0.0),
    near: float = NEAR,
    max_memory: int | None = None,
) -> Float32:
    """Render raw Gaussians for one camera: [height, width, 3].

    ``arrays`` are means, quats, scales, opacities, sh0 and shN, of any float dtype or layout (shapes: SplatArrays); the
    other arguments are those of NumpyRasterizer, which saves the allocation of scratch memory when it is kept.

    Raises:
        InputError: wrong shapes, values that are not finite, a quaternion without direction.
        MemoryError: all its tiles would take more than ``max_memory`` bytes at a time. They are drawn in parts where
            that is much, so that only a bound on the work is left of the limit.
    """
    splats = SplatArrays(*(np.ascontiguousarray(part, np.float32) for part in arrays))
    view = NumpyRasterizer(viewmat=viewmat, K=K, width=width, height=height, background=background, near=near)
    return view.forward(splats)[0] if max_memory is None else draw_by_parts(view, splats, max_memory)


class NumpyRasterizer(NativeRasterizer):
    """Rasteriser of one fixed camera. Keeps its scratch memory: reuse it for many frames.

    Not for use by two threads at once (raises RuntimeError); different objects may run side by side.

    Arguments:
        viewmat: [4, 4] world to camera, OpenCV axes.
        K: [3, 3] intrinsics in pixels without skew, origin at the image corner.
        width, height: pixels, 1 to 65536.
        background: linear RGB.
        near: near plane, scene units; Gaussians at this depth or closer are not drawn.
        native: the object that another NumpyRasterizer gave by `release`, for its memory.

    Raises:
        InputError: camera matrices of wrong shape, not finite, with skew or without a positive focal length.
    """

    # ---- the full path

    def forward(
        self,
        splats: SplatArrays,
        *,
        tile_mask: NDArray[np.bool_] | None = None,
        image: Float32 | None = None,
        transmittance: Float32 | None = None,
    ) -> tuple[Float32, Float32]:
        """Render. Also fills the cache for `freeze`.

        Raises:
            InputError: wrong dtype, shape or layout, values that are not finite, a singular quaternion.
        """
        splats = require_splats(splats)
        mask = require_mask(tile_mask, self.width, self.height)
        target = self._target(image, transmittance)
        faults = self._call("forward", native_scene(splats), *self._view, mask, *target)
        raise_on_faults(faults, splats)
        self._coefficients, self._scene_rows = splats.shN.shape[1] + 1, len(splats.means)
        return target

    def backward(
        self,
        v_image: Float32,
        v_alpha: Float32 | None = None,
        *,
        compact: bool = False,
        out: SplatGradients | None = None,
    ) -> SplatGradients:
        """Gradients of sum(v_image * image) + sum(v_alpha * (1 - transmittance)) over the tiles of the last forward.

        Raises:
            InputError: wrong dtype, shape or layout, or no matching forward.
        """
        self._expect("backward")
        rows = self._native.visible_count if compact else self._scene_rows
        gradients = self._gradients(rows, out)
        self._call("backward", *self._upstream(v_image, v_alpha), *gradients, compact)
        return gradients

    def visible_rows(self) -> NDArray[np.uint32]:
        """Ascending rows that touch a wanted tile in the last pass (after an active pass: indices into active_ids)."""
        rows = np.empty(self._native.visible_count, np.uint32)
        self._native.visible_rows(rows)
        return rows

    def touched_tiles(self) -> NDArray[np.bool_]:
        """[ceil(H / 16), ceil(W / 16)] bool: the tiles that the last active pass rendered.

        With ``touched_only`` only pixels are written that active rows touch, or touched when they were cached; all
        others equal the cache.

        Raises:
            InputError: no active pass yet.
        """
        tiles = np.empty((-(-self.height // MASK_TILE), -(-self.width // MASK_TILE)), np.bool_)
        self._call("touched_tiles", tiles.view(np.uint8))
        return tiles

    # ---- the incremental mode

    def freeze(self, tile_mask: NDArray[np.bool_] | None, active_ids: NDArray[np.uint32]) -> None:
        """Freeze all Gaussians of the last full forward but `active_ids`, and the view to `tile_mask`.

        Raises:
            InputError: no full forward yet, ids out of range or unsorted, tiles that are not cached.
        """
        if not isinstance(active_ids, np.ndarray) or active_ids.dtype != np.uint32 or active_ids.ndim != 1:
            got = f"{getattr(active_ids, 'dtype', type(active_ids).__name__)} {list(np.shape(active_ids))}"
            refuse(f"active_ids: expected uint32 [A], got {got}; convert with ids.astype(np.uint32)")
        self._expect("freeze")
        self._call("freeze", require_mask(tile_mask, self.width, self.height), np.ascontiguousarray(active_ids))

    def forward_active(
        self,
        rows: SplatArrays,
        *,
        image: Float32 | None = None,
        transmittance: Float32 | None = None,
        touched_only: bool = False,
    ) -> tuple[Float32, Float32]:
        """Render the frozen tiles with new values of the active rows: bit-identical to `forward` of the whole scene.

        Raises:
            InputError: wrong dtype, shape or layout, values that are not finite, no `freeze` since the last forward.
        """
        self._expect("forward_active")
        rows = require_splats(rows, self._native.active_count)
        target = self._target(image, transmittance)
        faults = self._call("forward_active", native_scene(rows), self._view.background, *target, touched_only)
        raise_on_faults(faults, rows)
        self._coefficients = rows.shN.shape[1] + 1
        return target

    def backward_active(
        self, v_image: Float32, v_alpha: Float32 | None = None, *, out: SplatGradients | None = None
    ) -> SplatGradients:
        """Gradients with respect to the active rows: bit-identical to these rows of `backward`.

        Raises:
            InputError: wrong dtype, shape or layout, or no matching forward_active.
        """
        self._expect("backward_active")
        gradients = self._gradients(self._native.active_count, out)
        self._call("backward_active", *self._upstream(v_image, v_alpha), *gradients)
        return gradients

    def update(self, changed: NDArray[np.uint32], rows: SplatArrays, image: Float32, transmittance: Float32) -> None:
        """Put new values of some rows into the cache and render anew the tiles these rows touched or touch.

        Afterwards the cache, and ``image`` and ``transmittance`` if they held the cached render, have the bits that
        `forward` of the changed scene would have given them. Ends the freeze.

        Raises:
            InputError: as forward, unordered ids, no full forward yet. Nothing was changed then.
        """
        changed = native_array("changed", changed, np.uint32, ("A",))
        rows = require_splats(rows, len(changed))
        target = self._target(image, transmittance)
        raise_on_faults(self._call("update", changed, native_scene(rows), self._view.background, *target), rows)

    def backward_cached(self, splats: SplatArrays, v_image: Float32) -> tuple[Float32, NDArray[np.bool_]]:
        """Gradient of sum(v_image * image) of the cached scene by its 2-D means [N, 2], and who is visible [N] bool.

        Nothing is rendered, and work follows the pixels at which ``v_image`` [H, W, 3] is not zero. Same bits as
        `backward` of a full forward gives. A backward of an active pass may still follow.

        Raises:
            InputError: wrong dtype, shape or layout, no full forward yet, another number of rows.
        """
        splats = require_splats(splats)
        v_means2d, visible = np.empty((len(splats.means), 2), np.float32), np.empty(len(splats.means), np.uint8)
        self._call("backward_cached", native_scene(splats), self._upstream(v_image, None)[0], v_means2d)
        self._call("visible_in_cache", visible)
        return v_means2d, visible.view(np.bool_)

    def backward_cached_rows(self, splats: SplatArrays, v_image: Float32) -> tuple[NDArray[np.int64], Float32]:
        """The rows that ``v_image`` reaches, [K] ascending, and their gradients [K, 2], with the bits of
        `backward_cached`.

        All other rows have a gradient of zero. Work and memory do not grow with the number of rows of the scene, but
        for one bit of each.

        Raises:
            InputError: as `backward_cached`.
        """
        splats = require_splats(splats)
        count = self._call("backward_cached_rows", native_scene(splats), self._upstream(v_image, None)[0])
        rows, gradient = np.empty(count, np.int64), np.empty((count, 2), np.float32)
        self._call("reached_rows", rows, gradient)
        return rows, gradient

    def contributing_in_cache(self, tile_mask: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
        """Say which rows of the cached scene added light to a pixel of the marked tiles: [N] bool.

        Nothing is rendered or differentiated; the lists of the marked tiles are read. At the image's border the 4 x 4
        blocks are counted whole, so a row may be named for a pixel up to three beyond the edge.

        Raises:
            InputError: wrong dtype or shape, no full forward yet, tiles that are not cached.
        """
        self._expect("contributing_in_cache")
        drawn = np.empty(self._native.scene_count, np.uint8)
        self._call("contributing_in_cache", require_mask(tile_mask, self.width, self.height), drawn)
        return drawn.view(np.bool_)

    def forward_cached(
        self,
        *,
        tile_mask: NDArray[np.bool_] | None = None,
        image: Float32 | None = None,
        transmittance: Float32 | None = None,
    ) -> tuple[Float32, Float32]:
        """Render the cached scene without projecting anything.

        Raises:
            InputError: no full forward yet, or tiles that are not cached.
        """
        self._expect("forward_cached")
        target = self._target(image, transmittance)
        self._call("forward_cached", self._view.background, require_mask(tile_mask, self.width, self.height), *target)
        return target
