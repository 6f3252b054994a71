"""How much memory a packet and a picture would take, known before they are decoded: for players with a limit.

A few bytes can announce millions of Gaussians inside the limits of the format. What a packet announces stands in its
first bytes; the factors below are peaks that were measured while decoding, with a margin.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import zstandard

from gsstream.core.memory import limited_memory, memory_limit, named_limit, require_memory
from gsstream.packet import PacketKind, PlayerState
from gsstream.packet.base import MAX_META, Section, add_offset, parse_packet
from gsstream.packet.bits import BitReader, unpack_blobs
from gsstream.player.render import PER_PIXEL

#: Bytes at the peak for every number of a Gaussian in a key packet or an added Gaussian (4 of them stay), for every
#: Gaussian that a delta reaches, and for every byte of meta as JSON (lists of empty objects are worst).
PER_NUMBER, PER_DELTA_ROW, PER_META_BYTE = 30, 200, 30
#: What a stream may take where nobody names a limit: so many bytes, and so many for each byte of the file up to the end
#: of the packet. Streams of recordings take at most 200 for each of theirs.
FREE, PER_STREAM_BYTE = 200_000_000, 1000
_COUNTS = struct.Struct("<II")


@dataclass(frozen=True, slots=True)
class MemoryLimit:
    """A limit in bytes on the memory for a stream, beside the program itself (about 80 MB).

    None: what :func:`gsstream.core.memory.memory_limit` says. Where nobody named that either, a packet is refused that
    announces far more than the bytes of its stream can honestly hold, so that a small file takes little memory.
    """

    most: int | None = None

    def check_packet(self, size: int, frame: int) -> None:
        """Refuse a packet of ``size`` bytes before it is read. Raises InputError."""
        self._check(2 * size, f"the packet of frame {frame}")

    def check_decoding(self, data: bytes, state: PlayerState | None, offset: int) -> None:
        """Refuse a packet by the sizes that it announces, before it is decoded.

        Raises InputError beyond the limit, PacketError for a damaged packet.
        """
        header, sections = parse_packet(data, offset)
        held = 0 if state is None else sum(array.nbytes for _, array in state.gaussians.items())
        wanted = held + 2 * len(data)
        if header.kind == PacketKind.KEY:
            wanted += _key(sections)
        elif header.kind == PacketKind.DELTA and state is not None:
            rows, numbers = len(state.gaussians), 14 + 3 * state.gaussians.shN.shape[1]
            wanted += rows * (PER_DELTA_ROW + 8 * numbers) + _num_added(sections) * PER_NUMBER * numbers
        with limited_memory(self._trusted(offset + len(data))):
            require_memory(wanted, f"decoding frame {header.frame}")

    def check_pictures(self, width: int, height: int, kept: int = 1) -> None:
        """Refuse pictures of a size of which ``kept`` are in memory at a time, as bytes. Raises InputError."""
        self._check(width * height * (PER_PIXEL + 3 * kept), f"drawing {width} x {height} pixels")

    def _trusted(self, size: int) -> int:
        """Bytes that decoding may take when so many bytes of the stream have been read."""
        if self.most is not None:
            return self.most
        limit = memory_limit()
        return limit if named_limit() is not None else min(limit, FREE + PER_STREAM_BYTE * size)

    def _check(self, wanted: int, what: str) -> None:
        with limited_memory(self.most):
            require_memory(wanted, what)


def _key(sections: dict[str, Section]) -> int:
    """Bytes for the sections of a key packet; the decoder refuses sections that are missing or cut short."""
    layout, rest, meta = (sections[name].data if name in sections else b"" for name in ("layout", "shN", "meta"))
    gaussians, nodes = _COUNTS.unpack_from(layout) if len(layout) >= _COUNTS.size else (0, 0)
    channels = rest[1] if len(rest) > 1 else 0
    try:
        text = min(max(0, zstandard.frame_content_size(meta)), MAX_META)
    except zstandard.ZstdError:
        text = 0
    return int(gaussians * PER_NUMBER * (14 + min(channels, 45)) + 64 * nodes + text * PER_META_BYTE)


def _num_added(sections: dict[str, Section]) -> int:
    """How many Gaussians a delta packet adds, by the head of its section."""
    if "added" not in sections:
        return 0
    section = sections["added"]
    with add_offset(section.offset):
        # The number stands in the first bits; a head may be as long as the packet, and bits take memory, too.
        return BitReader(unpack_blobs(section.data, 2)[0][:16]).gamma() + 1
