"""What `gsstream bench render` asks of a compiled renderer (entry point group `gsstream.bench`): threads, the machine's
peaks, and the kernels without torch around them. Imports no torch.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsstream_cpu_render import _bench
from gsstream_cpu_render.arrays import Float32, SplatArrays, new_gradients, refuse_value
from gsstream_cpu_render.rasterizer import NumpyRasterizer
from gsstream_cpu_render.threads import instruction_set as instruction_set
from gsstream_cpu_render.threads import num_threads as num_threads
from gsstream_cpu_render.threads import set_num_threads as set_num_threads


def fma_peak(threads: int = 1, seconds: float = 0.2) -> float:
    """Measure 10^9 float32 operations per second (a multiply-add is two) in registers, over ``seconds`` in (0, 60]."""
    try:
        _bench.select_isa(instruction_set())
        return float(_bench.fma_peak(threads, seconds))
    except ValueError as error:
        refuse_value(str(error))


def copy_peak(threads: int = 1, megabytes: float = 64.0) -> float:
    """Measure 10^9 bytes per second, read plus written, copying ``megabytes`` (0.001 to 4096) a thread."""
    try:
        _bench.select_isa(instruction_set())
        return float(_bench.copy_peak(threads, megabytes))
    except ValueError as error:
        refuse_value(str(error))


class Kernel:
    """One scene, camera and tile mask with all memory at hand: `forward` and `backward` are nothing but kernel calls.

    Arguments:
        arrays: raw float32 parameters in the order of SplatArrays.
        tile_mask: [tile rows, tile columns] bool; None: all.
        active: ascending rows that change while all others are cached; None: all rows are drawn anew.
        v_image: [H, W, 3] float32, the gradient that backward starts from.
    """

    def __init__(
        self,
        arrays: tuple[Float32, ...],
        viewmat: ArrayLike,
        K: ArrayLike,
        width: int,
        height: int,
        near: float,
        tile_mask: NDArray[np.bool_] | None,
        active: NDArray[np.int64] | None,
        v_image: Float32,
    ) -> None:
        self._rasterizer = NumpyRasterizer(viewmat, K, width, height, near=near)
        self._splats, self._mask, self._v_image = SplatArrays(*arrays), tile_mask, v_image
        self._incremental = active is not None
        self._image, self._transmittance = self._rasterizer.forward(self._splats, tile_mask=tile_mask)
        if active is not None:
            self._rasterizer.freeze(tile_mask, active.astype(np.uint32))
            self._splats = SplatArrays(*(np.ascontiguousarray(array[active]) for array in arrays))
        self._out = new_gradients(len(self._splats.means), self._splats.shN.shape[1] + 1)

    def forward(self) -> Any:
        """One forward pass into the same memory."""
        into = {"image": self._image, "transmittance": self._transmittance}
        if self._incremental:
            return self._rasterizer.forward_active(self._splats, touched_only=True, **into)
        return self._rasterizer.forward(self._splats, tile_mask=self._mask, **into)

    def backward(self) -> Any:
        """The backward pass of the last forward into the same memory."""
        if self._incremental:
            return self._rasterizer.backward_active(self._v_image, out=self._out)
        return self._rasterizer.backward(self._v_image, out=self._out)

    def statistics(self) -> dict[str, int]:
        """Counts of the last pass (visible, pairs, entries) and bytes of scratch memory."""
        return {**self._rasterizer.statistics(), "memory_bytes": self._rasterizer.memory_bytes()}
