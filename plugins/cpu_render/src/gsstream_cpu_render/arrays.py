"""The arrays that cross into the rasteriser, checked with messages for people. Imports no torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsstream_cpu_render import _native
from gsstream_cpu_render.checks import Float32, first_non_finite, native_array, refuse

SH_COEFFICIENTS = (1, 4, 9, 16)
MASK_TILE = 16
TOO_MANY_PAIRS = "the Gaussians cover more tiles of the picture than the limit on memory allows"


class SplatArrays(NamedTuple):
    """Raw parameters of N Gaussians: float32, C-contiguous."""

    means: Float32  # [N, 3] scene units
    quats: Float32  # [N, 4] wxyz, any norm between 1e-10 and 1e10
    #: [N, 3] natural log of the standard deviations; kept within about +-20.8 (factor 2^30) by the kernels.
    scales: Float32
    opacities: Float32  # [N] logits
    sh0: Float32  # [N, 1, 3] degree-0 coefficients
    shN: Float32  # [N, K-1, 3] higher coefficients, K in {1, 4, 9, 16}


class SplatGradients(NamedTuple):
    """Gradients with respect to SplatArrays, same shapes and row order, and to the 2-D means [N, 2] in pixels."""

    means: Float32
    quats: Float32
    scales: Float32
    opacities: Float32
    sh0: Float32
    shN: Float32
    means2d: Float32


def require_float32(name: str, value: Any, shape: Sequence[int | str], *, writable: bool = False) -> Float32:
    """`native_array` of float32. Raises gsstream's ShapeError."""
    return native_array(name, value, np.float32, shape, writable=writable)


def require_splats(splats: SplatArrays, rows: int | None = None) -> SplatArrays:
    """Numpy views of the arrays if dtypes and shapes agree.

    Raises:
        ShapeError: naming the array, what was expected and what came.
    """
    means = require_float32("means", splats.means, ("N" if rows is None else rows, 3))
    n = len(means)
    checked = SplatArrays(
        means=means,
        quats=require_float32("quats", splats.quats, (n, 4)),
        scales=require_float32("scales", splats.scales, (n, 3)),
        opacities=require_float32("opacities", splats.opacities, (n,)),
        sh0=require_float32("sh0", splats.sh0, (n, 1, 3)),
        shN=require_float32("shN", splats.shN, (n, "K-1", 3)),
    )
    bases = checked.shN.shape[1] + 1
    if bases not in SH_COEFFICIENTS:
        refuse(f"shN: expected K-1 coefficients with K in {SH_COEFFICIENTS}, got K = {bases}")
    return checked


def mask_shape(width: int, height: int) -> tuple[int, int]:
    """Shape of a tile mask: [ceil(H / 16), ceil(W / 16)]."""
    return -(-height // MASK_TILE), -(-width // MASK_TILE)


def require_mask(mask: Any, width: int, height: int) -> NDArray[np.uint8] | None:
    """A tile mask (bool or uint8) as contiguous uint8, or None for "all tiles".

    Raises:
        ShapeError: unless it is a bool or uint8 array of shape [ceil(H / 16), ceil(W / 16)].
    """
    if mask is None:
        return None
    wanted = list(mask_shape(width, height))
    if not isinstance(mask, np.ndarray) or mask.dtype not in (np.bool_, np.uint8):
        refuse(f"tile_mask: expected a bool or uint8 array {wanted}, got {getattr(mask, 'dtype', type(mask).__name__)}")
    if list(mask.shape) != wanted:
        tiles = f"16 x 16 pixel tiles of a {width} x {height} image"
        refuse(f"tile_mask: expected shape {wanted} ({tiles}), got {list(mask.shape)}")
    return np.ascontiguousarray(mask).view(np.uint8)


def gradient_shapes(rows: int, coefficients: int) -> tuple[tuple[int, ...], ...]:
    """Shapes of SplatGradients for `rows` Gaussians with K = `coefficients`."""
    return (rows, 3), (rows, 4), (rows, 3), (rows,), (rows, 1, 3), (rows, coefficients - 1, 3), (rows, 2)


def new_gradients(rows: int, coefficients: int) -> SplatGradients:
    """Uninitialised gradient arrays for `rows` Gaussians with K = `coefficients`."""
    return SplatGradients(*(np.empty(shape, np.float32) for shape in gradient_shapes(rows, coefficients)))


def raise_on_faults(faults: int, splats: SplatArrays) -> None:
    """Turn the kernel's fault bits into an error that names the first bad value.

    The kernels find faults while reading, so this search for the place runs only when there is one. Harmonics of
    Gaussians outside the view are never read and so not checked.

    Raises:
        ShapeError: a NaN or infinity (array and index), a quaternion without direction (row), or finite values so
            large that they overflow float32.
        MemoryError: more pairs of Gaussians and tiles than the rasteriser may make.
    """
    if not faults:
        return
    if faults & _native.FAULT_PAIRS:
        raise MemoryError(TOO_MANY_PAIRS)
    for name, value in splats._asdict().items():
        if found := first_non_finite(name, value):
            refuse(found)
    norms = np.linalg.norm(splats.quats.astype(np.float64), axis=1)
    unusable = ~((norms > 1e-10) & (norms < 1e10))
    if faults & _native.FAULT_QUATERNION and unusable.any():
        row = int(np.argmax(unusable))
        got = f"{norms[row]:.3g} at row {row} ({int(unusable.sum())} in all)"
        refuse(f"quats: expected norms between 1e-10 and 1e10, got {got}; give them a direction")
    refuse("a product of finite parameters overflowed float32; expected values below about 1e15; rescale the scene")
