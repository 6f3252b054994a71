"""What a packet is: kinds, sections, limits, the fixed header and its check. Normative text: docs/spec."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple

from gsstream.core.errors import PacketError
from gsstream.core.gaussians import ATTRIBUTES

FORMAT_MAJOR, FORMAT_MINOR = 2, 4
FORMAT_VERSION = f"{FORMAT_MAJOR}.{FORMAT_MINOR}"
#: First byte not ASCII, a CR LF and a lone LF: text-mode transfers and terminals are noticed, as in PNG.
MAGIC = b"\x89GSS\r\n\x1a\n"
FILE_HEADER = struct.Struct("<8sHHI")
PACKET_HEADER = struct.Struct("<BBHIII")
SECTION_HEADER = struct.Struct("<BI")

#: Limits a reader enforces before it allocates. A stream beyond them is refused, not truncated.
MAX_GAUSSIANS = 4_000_000
#: A key packet of B bytes announces at most FREE_GAUSSIANS + MAX_GAUSSIANS_PER_BYTE * B Gaussians and nodes.
FREE_GAUSSIANS = 1 << 16
MAX_GAUSSIANS_PER_BYTE = 64
MAX_BODY = 1 << 30
MAX_SECTIONS = 16
MAX_META = 1 << 20
MAX_UNITS = 64
#: Units stay below this, so that no residual leads out of the range of float32.
MAX_UNIT = 1e9
MAX_CHANNELS = 64
WIDTHS: Mapping[str, tuple[int, ...]] = {
    "means": (3,),
    "quats": (4,),
    "scales": (3,),
    "opacities": (1,),
    "sh0": (3,),
    "shN": (0, 9, 24, 45),
}


def most_gaussians(size: int) -> int:
    """Return how many Gaussians (and nodes) a key packet of ``size`` bytes may announce.

    This bounds what a small lie costs.
    """
    return min(MAX_GAUSSIANS, FREE_GAUSSIANS + MAX_GAUSSIANS_PER_BYTE * size)


class PacketKind(IntEnum):
    """The type byte of a packet."""

    KEY = 1
    DELTA = 2
    EMPTY = 3
    INDEX = 4


SECTION_NAMES: Mapping[int, str] = {
    1: "meta", 2: "layout", 3: "gates", 4: "decoders", 5: "index", 6: "removed", 7: "added",
    8: "motion", 9: "pattern", 10: "field", 11: "layers", 12: "rest", 13: "light",
    **{16 + i: name for i, name in enumerate(ATTRIBUTES)}
}  # fmt: skip
SECTION_IDS: Mapping[str, int] = {name: number for number, name in SECTION_NAMES.items()}


class Section(NamedTuple):
    """Payload of one section. ``offset`` is the byte in the file at which it starts, for error messages."""

    data: bytes
    offset: int


class PacketHeader(NamedTuple):
    """The fixed header. ``body`` is the length of everything after it, in bytes."""

    kind: PacketKind
    sections: int
    frame: int
    body: int
    checksum: int


@dataclass(frozen=True, slots=True)
class EncodedPacket:
    """A complete packet, as it is written.

    Arguments:
        data: every byte, header included.
        sizes: section name -> bytes; ``header`` holds the fixed header and the section headers. The sum is len(data).
        decoded: the PlayerState that ``decode_packet`` made of it, where it was decoded; it is not written.
    """

    data: bytes
    sizes: Mapping[str, int]
    decoded: object = field(default=None, compare=False, repr=False)

    @property
    def kind(self) -> PacketKind:
        return PacketKind(self.data[0])

    @property
    def frame(self) -> int:
        return int(PACKET_HEADER.unpack_from(self.data)[3])


@contextmanager
def add_offset(offset: int) -> Iterator[None]:
    """Give a PacketError that does not know where it happened the offset of the section being read."""
    try:
        yield
    except PacketError as error:
        if error.offset is not None:
            raise
        raise PacketError(str(error), offset) from error


def file_header() -> bytes:
    """Return the 16 bytes that every stream begins with."""
    head = struct.pack("<8sHH", MAGIC, FORMAT_MAJOR, FORMAT_MINOR)
    return head + struct.pack("<I", zlib.crc32(head))


def check_file_header(data: bytes) -> str:
    """Return the format version a stream was written in. Raises PacketError unless this version can read it."""
    if len(data) < FILE_HEADER.size:
        raise PacketError(f"not a gsstream file: expected {FILE_HEADER.size} header bytes, got {len(data)}", 0)
    magic, major, minor, crc = FILE_HEADER.unpack_from(data)
    if magic != MAGIC:
        raise PacketError(f"not a gsstream file: expected it to begin with {MAGIC!r}, got {magic!r}", 0)
    if crc != zlib.crc32(data[: FILE_HEADER.size - 4]):
        raise PacketError("the file header is damaged: its checksum does not match", 8)
    if major != FORMAT_MAJOR:
        raise PacketError(
            f"packet format {major}.{minor} cannot be read: this gsstream reads {FORMAT_MAJOR}.x; "
            "play it with the gsstream that wrote it",
            8,
        )
    if minor > FORMAT_MINOR:
        raise PacketError(f"packet format {major}.{minor} is newer than {FORMAT_VERSION}: upgrade gsstream", 8)
    return f"{major}.{minor}"


def build_packet(kind: PacketKind, frame: int, sections: Sequence[tuple[str, bytes]]) -> EncodedPacket:
    """Put (name, payload) sections, in their order, into a packet. Raises PacketError beyond a stated limit."""
    body = b"".join(SECTION_HEADER.pack(SECTION_IDS[name], len(data)) + data for name, data in sections)
    if len(body) > MAX_BODY or not 0 <= frame < 1 << 32:
        raise PacketError(f"packet of frame {frame}: {len(body)} bytes; expected at most {MAX_BODY} and a 32-bit frame")
    checksum = zlib.crc32(body, zlib.crc32(struct.pack("<BBII", kind, len(sections), frame, len(body))))
    check = _header_check(kind, len(sections), frame, body=len(body), checksum=checksum)
    header = PACKET_HEADER.pack(kind, len(sections), check, frame, len(body), checksum)
    sizes = {name: len(data) for name, data in sections}
    sizes["header"] = len(header) + SECTION_HEADER.size * len(sections)
    return EncodedPacket(header + body, sizes)


def _header_check(kind: int, sections: int, frame: int, body: int, checksum: int) -> int:
    # A damaged length must not be taken for an unfinished tail, so the header has a check of its own.
    return zlib.crc32(struct.pack("<BBIII", kind, sections, frame, body, checksum)) & 0xFFFF


def parse_header(data: bytes, offset: int) -> PacketHeader:
    """Read the fixed header at the start of ``data`` (file offset ``offset``). Raises PacketError."""
    if len(data) < PACKET_HEADER.size:
        raise PacketError(f"packet header cut short: expected {PACKET_HEADER.size} bytes, got {len(data)}", offset)
    kind, sections, check, frame, body, checksum = PACKET_HEADER.unpack_from(data)
    if check != _header_check(kind, sections, frame, body=body, checksum=checksum):
        raise PacketError("packet header damaged: its check does not match", offset)
    if kind not in PacketKind._value2member_map_:
        raise PacketError(f"unknown packet type {kind}; expected {[int(k) for k in PacketKind]}", offset)
    if sections > MAX_SECTIONS or body > MAX_BODY or body < sections * SECTION_HEADER.size:
        raise PacketError(f"packet header impossible: {sections} sections in {body} bytes", offset)
    return PacketHeader(kind=PacketKind(kind), sections=sections, frame=frame, body=body, checksum=checksum)


def parse_packet(data: bytes, offset: int = 0) -> tuple[PacketHeader, dict[str, Section]]:
    """Check a complete packet and split it into sections. Raises PacketError with the byte offset."""
    header = parse_header(data, offset)
    body = data[PACKET_HEADER.size :]
    if len(body) != header.body:
        raise PacketError(f"packet body: expected {header.body} bytes, got {len(body)}", offset)
    start = zlib.crc32(struct.pack("<BBII", header.kind, header.sections, header.frame, header.body))
    if zlib.crc32(body, start) != header.checksum:
        raise PacketError(f"packet of frame {header.frame} is damaged: its checksum does not match", offset)
    return header, split_sections(body, header.sections, offset + PACKET_HEADER.size)


def split_sections(body: bytes, number: int, offset: int) -> dict[str, Section]:
    """Return name -> section of bytes that must hold that many sections and nothing else. Raises PacketError."""
    found: dict[str, Section] = {}
    at = 0
    for _ in range(number):
        where = offset + at
        if at + SECTION_HEADER.size > len(body):
            raise PacketError("section header runs past the end of its packet", where)
        number, length = SECTION_HEADER.unpack_from(body, at)
        name = SECTION_NAMES.get(number)
        if name is None or name in found:
            why = "is unknown; upgrade gsstream" if name is None else "is repeated"
            raise PacketError(f"section {number} {why}", where)
        at += SECTION_HEADER.size
        if length > len(body) - at:
            raise PacketError(f"section {name}: {length} bytes announced, {len(body) - at} left in the packet", where)
        found[name] = Section(body[at : at + length], offset + at)
        at += length
    if at != len(body):
        raise PacketError(f"{len(body) - at} bytes after the last section", offset + at)
    return found


def expect(data: bytes, offset: int, kind: PacketKind) -> tuple[PacketHeader, dict[str, Section]]:
    """Parse a packet that must be of one kind. Raises PacketError like :func:`parse_packet`."""
    header, sections = parse_packet(data, offset)
    if header.kind != kind:
        raise PacketError(f"expected a {kind.name.lower()} packet, got {header.kind.name.lower()}", offset)
    return header, sections
