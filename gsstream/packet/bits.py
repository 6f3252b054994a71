"""Bit fields for the small numbers of a packet: Exp-Golomb codes, most significant bit first, zero padded."""

from __future__ import annotations

import numpy as np
import zstandard

from gsstream.core.errors import PacketError

#: Longest Exp-Golomb prefix a reader accepts; zigzagged 33-bit differences of int32 symbols need 34.
MAX_PREFIX = 36


class BitWriter:
    """Collects bit fields."""

    def __init__(self) -> None:
        self._parts: list[str] = []

    def bits(self, value: int, width: int) -> None:
        """Return ``width`` bits of a non-negative value."""
        if width:
            self._parts.append(format(value, f"0{width}b"))

    def gamma(self, value: int) -> None:
        """Return the Exp-Golomb code (order 0) of a value >= 0, which has 2 log2(value + 1) + 1 bits."""
        code = format(value + 1, "b")
        self._parts.append("0" * (len(code) - 1) + code)

    def signed(self, value: int) -> None:
        """Return the Exp-Golomb code of a signed value, after a zigzag."""
        self.gamma(2 * value if value >= 0 else -2 * value - 1)

    def digits(self, text: str) -> None:
        """Append fields that are written out already, as text of 0 and 1."""
        self._parts.append(text)

    def __len__(self) -> int:
        return sum(map(len, self._parts))

    def __str__(self) -> str:
        return "".join(self._parts)

    def extend(self, other: BitWriter) -> None:
        self._parts.extend(other._parts)

    def to_bytes(self) -> bytes:
        return np.packbits(np.frombuffer(str(self).encode(), np.uint8) - ord("0")).tobytes()


class BitReader:
    """Reads the bits that :class:`BitWriter` wrote. Every overrun is a PacketError."""

    def __init__(self, data: bytes) -> None:
        # A string of digits: str.find and int(text, 2) are the fastest bit scans the standard library has.
        self._text = (np.unpackbits(np.frombuffer(data, np.uint8)) + ord("0")).tobytes().decode()
        self._at = 0

    def bits(self, width: int) -> int:
        end = self._at + width
        if end > len(self._text):
            raise PacketError(f"bit field of {width} bits runs past the end of its section")
        value = int(self._text[self._at : end], 2) if width else 0
        self._at = end
        return value

    def gamma(self) -> int:
        one = self._text.find("1", self._at, self._at + MAX_PREFIX)
        if one < 0:
            raise PacketError("number code without an end, or too large")
        zeros = one - self._at
        self._at = one
        return self.bits(zeros + 1) - 1

    def signed(self) -> int:
        value = self.gamma()
        return -((value + 1) >> 1) if value & 1 else value >> 1

    def finish(self) -> None:
        """Check that only zero padding to the next byte is left."""
        rest = self._text[self._at :]
        if len(rest) >= 8 or "1" in rest:
            raise PacketError(f"{len(rest)} bits left over after the last field")


def pack_blobs(blobs: list[bytes]) -> bytes:
    """Concatenate byte strings, each but the last preceded by its length as LEB128."""
    return b"".join(_varint(len(blob)) + blob for blob in blobs[:-1]) + blobs[-1]


def unpack_blobs(data: bytes, count: int) -> list[bytes]:
    """Split the bytes that :func:`pack_blobs` joined. Raises PacketError when a length runs past the end."""
    blobs, at = [], 0
    for _ in range(count - 1):
        length, shift = 0, 0
        while True:
            if at >= len(data) or shift > 28:
                raise PacketError("length of a part runs past the end of its section")
            byte = data[at]
            at += 1
            length |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                break
        if length > len(data) - at:
            raise PacketError(f"part of {length} bytes announced, {len(data) - at} left in the section")
        blobs.append(data[at : at + length])
        at += length
    return [*blobs, data[at:]]


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    out.append(value)
    return bytes(out)


#: Level of zstandard, for text that has no better model.
_LEVEL = 12


def compress(data: bytes) -> bytes:
    """Return one zstandard frame that states its content size."""
    return zstandard.ZstdCompressor(level=_LEVEL, write_content_size=True).compress(data)


def decompress(data: bytes, limit: int) -> bytes:
    """Return the argument of :func:`compress`. The announced size is checked against ``limit`` before allocating."""
    try:
        size = zstandard.frame_content_size(data)
        dictionary = zstandard.get_frame_parameters(data).dict_id
    except zstandard.ZstdError as error:
        raise PacketError(f"not a zstandard frame: {error}") from error
    if data[:4] != zstandard.FRAME_HEADER or dictionary:
        raise PacketError("expected a zstandard frame without a dictionary")
    if size < 0 or size > limit:
        raise PacketError(f"compressed part announces {size} bytes; expected at most {limit}")
    try:
        # The window is bounded by the content size in frames of known size, so this allocates about `size` bytes.
        out: bytes = zstandard.ZstdDecompressor().decompress(data, max_output_size=size, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise PacketError(f"compressed part is damaged: {error}") from error
    if len(out) != size:
        raise PacketError(f"compressed part: expected {size} bytes, got {len(out)}")
    return out
