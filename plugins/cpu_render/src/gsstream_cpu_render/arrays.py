"""The arrays that cross into the native kernels, checked with messages for people. Imports no torch."""

from __future__ import annotations

import math
import mmap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from gsstream_cpu_render import _native

if TYPE_CHECKING:
    import torch

    from gsstream.api import Gaussians

Float32 = NDArray[np.float32]
SH_COEFFICIENTS = (1, 4, 9, 16)
MASK_TILE = 16
TOO_MANY_PAIRS = "the Gaussians cover more tiles of the picture than the limit on memory allows"


def refuse(message: str) -> NoReturn:
    """Raise gsstream's ShapeError (a ValueError)."""
    # Late, because the front door imports torch, which users of the numpy functions need not wait for.
    from gsstream.api import ShapeError

    raise ShapeError(message)


def refuse_value(message: str) -> NoReturn:
    """Raise gsstream's InputError (a ValueError) for a setting that is no array."""
    from gsstream.api import InputError

    raise InputError(message)


def as_array(name: str, value: Any) -> NDArray[Any]:
    """View ``value`` (numpy array or CPU torch tensor) as a numpy array that shares its memory."""
    if hasattr(value, "detach"):
        if value.device.type != "cpu":
            refuse(f"{name}: expected a tensor on the CPU, got one on {value.device}; call .cpu() first")
        if str(value.dtype) == "torch.bfloat16":
            refuse(f"{name}: expected float32, got bfloat16, which numpy does not know; convert it with .float()")
        value = value.detach().numpy()
    if not isinstance(value, np.ndarray):
        refuse(f"{name}: expected a numpy array or a torch tensor, got {type(value).__name__}")
    return value


def native_array(
    name: str, value: Any, dtype: type[np.generic], shape: Sequence[int | str], *, writable: bool = False
) -> NDArray[Any]:
    """Check what a kernel relies on: dtype, shape (letters stand for any size), C order, and that results can be kept.

    Nothing is converted: a converted copy of an output would swallow the result.
    """
    array = as_array(name, value)
    wanted = np.dtype(dtype)
    if array.dtype != wanted:
        refuse(f"{name}: expected dtype {wanted}, got {array.dtype}; convert it with .astype (numpy) or .to (torch)")
    fits = len(shape) == array.ndim and all(
        isinstance(want, str) or want == got for want, got in zip(shape, array.shape, strict=True)
    )
    if not fits:
        refuse(f"{name}: expected shape [{', '.join(map(str, shape))}], got {list(array.shape)}")
    if not array.flags.c_contiguous:
        refuse(
            f"{name}: expected a contiguous array, got strides {array.strides} for shape {list(array.shape)}; "
            "make it contiguous first (numpy.ascontiguousarray, .contiguous())"
        )
    if writable and not array.flags.writeable:
        refuse(f"{name}: expected a writable array (it is changed in place), got a read-only one; give a copy")
    return array


def lasting_array(shape: tuple[int, ...], dtype: type[np.generic]) -> NDArray[Any]:
    """Return a writable array of zeros in pages of its own, for what outlives the temporary arrays around it.

    Pages take memory when they are first written, and go back to the system with the array; on the heap, such arrays
    among those that come and go with every picture keep it from being used again.
    """
    count = math.prod(shape)
    pages = mmap.mmap(-1, max(1, count * np.dtype(dtype).itemsize))
    return np.frombuffer(pages, dtype, count).reshape(shape)


def first_non_finite(name: str, array: NDArray[Any]) -> str | None:
    """Describe the first value of ``array`` that is not finite, or None."""
    bad = np.flatnonzero(~np.isfinite(array))
    if len(bad) == 0:
        return None
    index = [int(i) for i in np.unravel_index(int(bad[0]), array.shape)]
    return f"{name}: expected finite values, got {array.flat[int(bad[0])]} at index {index} ({len(bad)} such values)"


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


def splats_of(gaussians: Gaussians[torch.Tensor]) -> SplatArrays:
    """Views of the tensors (copies only where a tensor is not contiguous)."""
    return SplatArrays(*(as_array(name, value.contiguous()) for name, value in gaussians.items()))


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
