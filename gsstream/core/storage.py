"""How images wait in memory: as they are or as bytes. Values are always worked on as float32."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsstream.core.shapes import FloatArray

#: Values that are compared at a time: so many stay in the processor's cache.
CHUNK = 1 << 15


def packed(images: FloatArray) -> Any:
    """Return images [..., 3] float32 as uint8 if :func:`unpacked` then gives the same values, else as they are.

    Bytes say the same of a recording of 8 bits that is read at its size.
    """
    if images.dtype == np.uint8:
        return images
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


def to_bytes(images: FloatArray) -> Any:
    """Return images [..., 3] in [0, 1] rounded to the nearest of the 256 levels of uint8."""
    return np.rint(np.clip(images, 0, 1) * np.float32(255)).astype(np.uint8)


def unpacked(images: Any) -> FloatArray:
    """Return the float32 images of which :func:`packed` made this array; float32 itself is passed on as it is."""
    if images.dtype == np.uint8:
        return np.asarray(np.divide(images, np.float32(255), dtype=np.float32))
    return np.asarray(images, np.float32)
