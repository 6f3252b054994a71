"""How images wait in memory: as they are or as bytes. Values are always worked on as float32."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from gsstream.core.errors import ShapeError
from gsstream.core.shapes import FloatArray

#: "auto": bytes where they say the same, as those of a recording of 8 bits read at its size do; else float32.
Storage = Literal["auto", "float32", "uint8"]
#: Values that are compared at a time: so many stay in the processor's cache.
CHUNK = 1 << 15


def packed(images: FloatArray, storage: Storage) -> Any:
    """Return images [..., 3] float32 in [0, 1] as an array of the kind ``storage``; bytes are off by up to 1/510.

    Raises ShapeError for values outside [0, 1] where bytes cannot hold them, NaN included.
    """
    if storage == "float32" or images.dtype == np.uint8:
        return images
    if storage == "auto":
        return _as_bytes(images)
    if images.ndim > 3:  # view by view: what it takes on the way must not eat what it saves
        views = np.empty(images.shape, storage)
        for out, view in zip(views, images, strict=True):
            out[...] = packed(view, storage)
        return views
    if images.size:
        low, high = float(images.min()), float(images.max())
        if not (low >= 0 and high <= 1):
            raise ShapeError(f"images: expected values from 0 to 1 to store as uint8, got {low:g} to {high:g}")
    return np.rint(images * np.float32(255)).astype(np.uint8)


def _as_bytes(images: FloatArray) -> Any:
    """The images as uint8 if :func:`unpacked` then gives the same values, else as they are."""
    stored = np.empty(images.shape, np.uint8)
    values, codes, back = images.reshape(-1), stored.reshape(-1), np.empty(CHUNK, np.float32)
    for begin in range(0, values.size, CHUNK):
        some = values[begin : begin + CHUNK]
        levels, code = back[: len(some)], codes[begin : begin + CHUNK]
        np.rint(np.multiply(some, np.float32(255), out=levels), out=levels)
        with np.errstate(invalid="ignore"):  # what no byte can hold differs when it comes back
            code[...] = levels
        if not np.array_equal(np.divide(code, np.float32(255), out=levels), some):
            return images
    return stored


def unpacked(images: Any) -> FloatArray:
    """Return the float32 images of which :func:`packed` made this array; float32 itself is passed on as it is."""
    if images.dtype == np.uint8:
        return np.asarray(np.divide(images, np.float32(255), dtype=np.float32))
    return np.asarray(images, np.float32)


def rounded(images: FloatArray, storage: Storage) -> FloatArray:
    """Return the values that are left of images once they were stored as ``storage``."""
    return images if storage in ("auto", "float32") else unpacked(packed(images, storage))
