"""Zstandard for text that has no better model, with the size checked before it is allocated."""

from __future__ import annotations

import zstandard

from gsstream.core.errors import PacketError

_LEVEL = 12


def compress(data: bytes) -> bytes:
    """Return one zstandard frame that states its content size."""
    return zstandard.ZstdCompressor(level=_LEVEL, write_content_size=True).compress(data)


def decompress(data: bytes, limit: int) -> bytes:
    """Return what :func:`compress` was given. The announced size is checked against ``limit`` before allocating."""
    try:
        size = zstandard.frame_content_size(data)
    except zstandard.ZstdError as error:
        raise PacketError(f"not a zstandard frame: {error}") from error
    if size < 0 or size > limit:
        raise PacketError(f"compressed part announces {size} bytes; expected at most {limit}")
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
