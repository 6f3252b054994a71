"""Byte-shuffled zstandard for tables that have no better model."""

from __future__ import annotations

import numpy as np
import zstandard

from gsstream.core.errors import PacketError
from gsstream.core.shapes import FloatArray, IntArray

_LEVEL = 12


def compress(data: bytes) -> bytes:
    """One zstandard frame that states its content size."""
    return zstandard.ZstdCompressor(level=_LEVEL, write_content_size=True).compress(data)


def decompress(data: bytes, limit: int, exact: int | None = None) -> bytes:
    """Inverse of :func:`compress`. The announced size is checked against ``limit`` and ``exact`` before allocating."""
    try:
        size = zstandard.frame_content_size(data)
    except zstandard.ZstdError as error:
        raise PacketError(f"not a zstandard frame: {error}") from error
    if size < 0 or size > limit or (exact is not None and size != exact):
        wanted = f"at most {limit}" if exact is None else f"exactly {exact}"
        raise PacketError(f"compressed part announces {size} bytes; expected {wanted}")
    if size == 0:
        return b""
    try:
        # The window is bounded by the content size in frames of known size, so this allocates about `size` bytes.
        out: bytes = zstandard.ZstdDecompressor().decompress(data, max_output_size=size, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise PacketError(f"compressed part is damaged: {error}") from error
    if len(out) != size:
        raise PacketError(f"compressed part: expected {size} bytes, got {len(out)}")
    return out


def pack_array(array: FloatArray | IntArray, dtype: str) -> bytes:
    """Little-endian ``dtype``, bytes of equal significance together, compressed."""
    flat = np.ascontiguousarray(array, dtype=dtype).reshape(-1)
    return compress(flat.view(np.uint8).reshape(-1, flat.itemsize).T.tobytes())


def unpack_array(data: bytes, dtype: str, count: int) -> FloatArray | IntArray:
    """[count] array of a native byte order. Raises PacketError (without offset)."""
    size = np.dtype(dtype).itemsize
    raw = np.frombuffer(decompress(data, count * size, count * size), np.uint8)
    values = np.ascontiguousarray(raw.reshape(size, count).T).view(dtype).reshape(-1)
    return values.astype(values.dtype.newbyteorder("="))
