"""Axis legend and shape checks.

====== =======================================================
letter meaning
====== =======================================================
N      Gaussians
A      Gaussians that may change in this frame (active rows)
M      nodes of a hierarchy (gates live on nodes)
C      cameras
H, W   image rows, columns (pixels)
K      spherical-harmonic bases, (degree + 1) ** 2
L      latent channels of a residual
====== =======================================================
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gsstream.core.deferred import require
from gsstream.core.errors import ShapeError

FloatArray = np.ndarray[Any, np.dtype[np.floating[Any]]]
IntArray = np.ndarray[Any, np.dtype[np.integer[Any]]]
BoolArray = np.ndarray[Any, np.dtype[np.bool_]]


def as_array(name: str, values: Any) -> np.ndarray[Any, Any]:
    """Return an array as it is, and of anything else, such as lists of lists, an array. Raises ShapeError."""
    try:
        return np.asarray(values)
    except ValueError as error:
        raise ShapeError(f"{name}: expected an array, or lists of equal lengths: {error}") from error


def check_shape(name: str, array: Any, expected: Sequence[int | str]) -> dict[str, int]:
    """Check the shape of an array; letters of the expected shape bind to sizes.

    Arguments:
        name: name of the array, for the error.
        array: anything with a ``shape``.
        expected: sizes, letters that bind to sizes, or ``...``.

    Returns the bound letters. Raises ShapeError naming the array, what was expected and what came.
    """
    shape = tuple(int(n) for n in array.shape)
    bound: dict[str, int] = {}
    ok = len(shape) == len(expected)
    for want, got in zip(expected, shape, strict=False):
        ok = ok and (bound.setdefault(want, got) == got if isinstance(want, str) else want == got)
    if not ok:
        raise ShapeError(f"{name}: expected shape [{', '.join(map(str, expected))}], got {list(shape)}")
    return bound


def check_finite(name: str, array: Any) -> None:
    """Raise ShapeError naming the first non-finite index of a numpy array or torch tensor.

    For a tensor on a GPU no index is named, and the error may come later (``gsstream.core.deferred``).
    """
    if hasattr(array, "detach") and array.device.type != "cpu":
        message = f"{name}: expected finite values, got some that are not"
        require(array.detach().isfinite().all(), lambda: ShapeError(message))
        return
    values = array.detach().numpy() if hasattr(array, "detach") else np.asarray(array)
    # A sum is finite only if every term is, and costs one pass without a temporary.
    with np.errstate(over="ignore", invalid="ignore"):
        if np.isfinite(values.sum(dtype=np.float64)):
            return
    bad = np.argwhere(~np.isfinite(values))
    if len(bad) == 0:
        return
    index = tuple(int(i) for i in bad[0])
    raise ShapeError(
        f"{name}: expected finite values, got {values[index]} at index {list(index)} "
        f"({len(bad)} of {values.size} values are not finite)"
    )
