"""Checks of arrays at the border to the native kernels. No torch is imported here."""

from __future__ import annotations

import math
import mmap
from collections.abc import Sequence
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]


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
