"""The native rasteriser of one camera, arguments checked: what NumpyRasterizer is built on. Imports no torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gsstream_cpu_render import _native
from gsstream_cpu_render.arrays import (
    Float32,
    SplatArrays,
    SplatGradients,
    gradient_shapes,
    new_gradients,
    raise_on_faults,
    refuse,
    refuse_value,
    require_float32,
    require_splats,
)
from gsstream_cpu_render.loss import PreparedImage, weighted
from gsstream_cpu_render.view import NEAR, Background, checked_view

#: Bytes at the peak of a forward pass for every Gaussian, and for every pair of a Gaussian and a tile, measured.
SPLAT_BYTES, PAIR_BYTES = 120, 48


def native_scene(splats: SplatArrays) -> Any:
    """The checked arrays as the one handle that the kernels take; nothing is copied."""
    return _native.Scene(*splats)


class NativeRasterizer:
    """Life, memory and checks of a native rasteriser; arguments: see NumpyRasterizer."""

    def __init__(
        self,
        viewmat: ArrayLike,
        K: ArrayLike,
        width: int,
        height: int,
        background: Background = (0.0, 0.0, 0.0),
        near: float = NEAR,
        *,
        native: Any = None,
    ) -> None:
        self._view = checked_view(viewmat, K, width, height=height, background=background, near=near)
        self.width, self.height = self._view.width, self._view.height
        self._native = _native.Rasterizer() if native is None else native
        self._coefficients = 1
        self._scene_rows = 0

    # ---- memory

    def forget(self) -> None:
        """Let go of the arrays kept for backward (the cache stays). No backward may follow."""
        self._native.forget()
        self._coefficients, self._scene_rows = 1, 0

    def free_scratch(self) -> None:
        """Free the memory that only full passes need; the cache stays. No backward may follow; call freeze again."""
        self._native.free_scratch()

    def limit_memory(self, most: int, rows: int) -> None:
        """Let forward passes of ``rows`` Gaussians take at most ``most`` bytes; they raise MemoryError before more."""
        self._native.limit_pairs(max(0, most - SPLAT_BYTES * rows) // PAIR_BYTES)

    def release(self) -> Any:
        """Give away the native object with its memory. This object is of no use afterwards."""
        native, self._native = self._native, None
        native.forget()
        return native

    # ---- facts

    @property
    def passes(self) -> int:
        """Number of passes so far: tells whether a backward still belongs to its forward."""
        return int(self._native.passes)

    def memory_bytes(self) -> int:
        """Bytes of scratch and cache held by this object: about 64 per Gaussian and 100 per (Gaussian, tile) pair."""
        return int(self._native.memory_bytes())

    def cache_bytes(self) -> int:
        """Bytes of the cache alone: 64 per Gaussian, 16 per (Gaussian, tile) pair, 8 per pixel."""
        return int(self._native.cache_bytes())

    def statistics(self) -> dict[str, int]:
        """Counts of the last pass: visible Gaussians, (Gaussian, tile) pairs with gradients, entries composited."""
        return {
            "visible": self._native.visible_count,
            "pairs": self._native.pair_count,
            "entries": self._native.entry_count,
        }

    # ---- one iteration of a fit

    @property
    def handle(self) -> Any:
        """The native object, for calls that work on several rasterisers at once."""
        return self._native

    def comparison(
        self,
        cached_image: Float32 | None,
        target: PreparedImage,
        dssim_weight: float,
        colours: Sequence[Float32 | None],
        weights: Float32 | None,
    ) -> Any:
        """The target that renders are compared with, as the one handle that the kernels take.

        Raises:
            InputError: arrays of another shape.
        """
        if cached_image is not None:
            require_float32("cached_image", cached_image, (self.height, self.width, 3))
        scale = 1.0 / target.image.size
        scales = (1.0 - dssim_weight) * scale, -dssim_weight * scale
        try:
            return _native.Comparison(self._view.background, cached_image, target.handle, *colours, *scales, weights)
        except ValueError as error:
            refuse_value(str(error))

    def loss_and_grad_active(
        self,
        rows: SplatArrays,
        cached_image: Float32,
        target: PreparedImage,
        dssim_weight: float,
        colours: Sequence[Float32 | None],
        weights: Float32 | None,
        out: SplatArrays,
    ) -> float:
        """Render the active rows, compute the loss and write the gradient by the rows: one iteration of a fit.

        It stands for `forward_active` with ``touched_only``, `photometric_loss` with ``around`` and `backward_active`,
        one after the other; whole images are neither made nor copied, and frozen Gaussians in front of all active ones
        or behind them are blended once for all calls after a `forward`, not in each. By that colours differ from those
        of `forward_active` by 1e-4 of a Gaussian's colour and rounding; where nothing lies behind the active rows,
        not at all. The bits do not depend on earlier calls. Tiles that are left out stay as they are in the cache.

        Returns:
            The loss, of the tiles that are not left out.

        Raises:
            InputError: as forward_active; a loss that is not finite.
        """
        self._expect("forward_active")
        rows = require_splats(rows, self._native.active_count)
        comparison = self.comparison(cached_image, target, dssim_weight, colours=colours, weights=weights)
        try:
            result = self._native.loss_and_grad_active(native_scene(rows), comparison, *out)
        except ValueError as error:
            refuse_value(str(error))
        self._coefficients = rows.shN.shape[1] + 1
        return _loss_of(result, rows, target, dssim_weight)

    def full_loss_and_grad(
        self,
        splats: SplatArrays,
        target: PreparedImage,
        dssim_weight: float,
        colours: Sequence[Float32 | None],
        out: Sequence[Float32],
        exposure_grad: Float32 | None,
    ) -> float:
        """Render all Gaussians, compute the loss and write the gradient by all of them: an iteration of frame 0.

        It stands for `forward`, `photometric_loss` and `backward`, one after the other; whole images are neither made
        nor copied. No backward may follow. The bits do not depend on earlier calls or on the number of threads.

        Returns:
            The loss.

        Raises:
            InputError: as forward; a loss that is not finite.
        """
        splats = require_splats(splats)
        comparison = self.comparison(None, target, dssim_weight, colours=colours, weights=None)
        camera = self._view[:-1]  # the background is the comparison's
        try:
            result = _native.full_loss_and_grad(
                self._native, native_scene(splats), *camera, comparison, *out, exposure_grad
            )
        except ValueError as error:
            refuse_value(str(error))
        return _loss_of(result, splats, target, dssim_weight)

    # ---- checks

    def _expect(self, operation: str) -> None:
        """Raise InputError unless this operation may follow now; asked before its arguments meet the last pass."""
        try:
            self._native.expect(operation)
        except ValueError as error:
            refuse_value(str(error))

    def _call(self, name: str, *arguments: object) -> int:
        try:
            return getattr(self._native, name)(*arguments) or 0
        except ValueError as error:
            refuse_value(str(error))
        except MemoryError as error:  # its message is the name of a class in C++
            size = f"{self.width} x {self.height} pixels"
            raise MemoryError(f"{name}: the system has no memory for a view of {size} and its Gaussians") from error

    def _target(self, image: Float32 | None, transmittance: Float32 | None) -> tuple[Float32, Float32]:
        h, w = self.height, self.width
        if image is None:
            image = np.empty((h, w, 3), np.float32)
            image[:] = self._view.background
        if transmittance is None:
            transmittance = np.ones((h, w), np.float32)
        return (
            require_float32("image", image, (h, w, 3), writable=True),
            require_float32("transmittance", transmittance, (h, w), writable=True),
        )

    def _upstream(self, v_image: Float32, v_alpha: Float32 | None) -> tuple[Float32, Float32 | None]:
        require_float32("v_image", v_image, (self.height, self.width, 3))
        if v_alpha is not None:
            require_float32("v_alpha", v_alpha, (self.height, self.width))
        return v_image, v_alpha

    def _gradients(self, rows: int, out: SplatGradients | None) -> SplatGradients:
        if out is None:
            return new_gradients(rows, self._coefficients)
        for name, value, shape in zip(out._fields, out, gradient_shapes(rows, self._coefficients), strict=True):
            require_float32(f"out.{name}", value, shape, writable=True)
        return out


def _loss_of(
    result: tuple[int, float, float], splats: SplatArrays, target: PreparedImage, dssim_weight: float
) -> float:
    """The loss of fault bits and sums as a kernel gives them; raises InputError for faults."""
    faults, l1, dssim = result
    raise_on_faults(faults, splats)
    if not np.isfinite(l1 + dssim):
        refuse("image: expected colours of ordinary size, got some so large that the loss is not finite")
    return weighted(l1, dssim, dssim_weight, 1.0 / target.image.size)
