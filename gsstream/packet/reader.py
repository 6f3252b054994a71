"""StreamReader: the packets of a stream file, found by walking their headers. Bodies are read and checked on demand."""

from __future__ import annotations

import os
import struct
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import NamedTuple

from gsstream.core.errors import PacketError, SourceError
from gsstream.packet.base import FILE_HEADER, PACKET_HEADER, PacketKind, check_file_header, parse_header, parse_packet

INDEX_MAGIC = b"GSSX"
_INDEX_ENTRY = struct.Struct("<IQ")
_INDEX_TRAILER = struct.Struct("<Q4s")


class Entry(NamedTuple):
    """Where a packet lies: ``size`` bytes from ``offset``, header included."""

    kind: PacketKind
    frame: int
    offset: int
    size: int


@dataclass(frozen=True, slots=True)
class TruncatedTail:
    """Bytes after the last complete packet: a packet that was being written. ``size`` bytes from ``offset``."""

    offset: int
    size: int


class StreamReader:
    """Reads a stream file; also one that is still growing (:meth:`refresh`).

    Several threads may :meth:`read` at the same time; :meth:`refresh` and :meth:`close` are of one thread alone.

    ``entries`` lists the complete packets in file order. A damage that stops the walk is kept, not raised, so that the
    frames before it can be played: ``unfinished`` for a packet cut short at the end of the file, ``damage`` (a
    PacketError with its byte offset) for anything else. :meth:`check` raises it.

    Raises PacketError when the file header is not that of a readable stream, SourceError when there is no file.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        try:
            # Unbuffered: a writer that resumes rewrites the index, and a buffer would go on showing the old bytes.
            self._file: FileIO = self.path.open("rb", buffering=0)
        except OSError as error:
            raise SourceError(f"cannot open the stream {self.path}: {error.strerror}; expected a .gss file") from error
        self._lock = threading.Lock()
        self.entries: list[Entry] = []
        self.unfinished: TruncatedTail | None = None
        self.damage: PacketError | None = None
        try:
            #: Format version of the file, "major.minor".
            self.version = check_file_header(self._read_at(0, FILE_HEADER.size))
        except PacketError:
            self._file.close()
            raise
        self.refresh()

    def __enter__(self) -> StreamReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._file.close()

    @property
    def end(self) -> int:
        """Byte after the last complete packet."""
        return self.entries[-1].offset + self.entries[-1].size if self.entries else FILE_HEADER.size

    @property
    def frames(self) -> list[Entry]:
        """Entries of key, delta and empty packets: one per frame, consecutive."""
        return [entry for entry in self.entries if entry.kind != PacketKind.INDEX]

    def refresh(self) -> None:
        """Walk on from the last complete packet; a file being written may have grown."""
        self.unfinished, self.damage = None, None
        if self.entries and self.entries[-1].kind == PacketKind.INDEX:
            self.entries.pop()  # a resumed writer replaces the index by packets
        total = os.fstat(self._file.fileno()).st_size
        try:
            while self.end < total:
                offset = self.end
                entry = self._entry_at(offset, total)
                if entry is None:
                    self.unfinished = TruncatedTail(offset, total - offset)
                    return
                self.entries.append(entry)
        except PacketError as error:
            self.damage = error

    def _entry_at(self, offset: int, total: int) -> Entry | None:
        """The packet at ``offset``, or None when the file ends before it does."""
        head = self._read_at(offset, PACKET_HEADER.size)
        if len(head) < PACKET_HEADER.size:
            return None
        header = parse_header(head, offset)
        size = PACKET_HEADER.size + header.body
        if offset + size > total:
            return None
        _check_order(self.entries, header.kind, header.frame, offset)
        return Entry(header.kind, header.frame, offset, size)

    def read(self, entry: Entry) -> bytes:
        """Return all bytes of a packet, checksum verified. Raises PacketError."""
        data = self._read_at(entry.offset, entry.size)
        if len(data) != entry.size:
            raise PacketError(f"packet of {entry.size} bytes: the file holds {len(data)} of them", entry.offset)
        parse_packet(data, entry.offset)
        return data

    def _read_at(self, offset: int, size: int) -> bytes:
        """Bytes of the file, fewer where it ends. The place that threads and forked processes share is not moved."""
        if hasattr(os, "pread"):
            return os.pread(self._file.fileno(), size, offset)
        with self._lock:  # a system without it
            self._file.seek(offset)
            return self._file.read(size)

    def __iter__(self) -> Iterator[tuple[Entry, bytes]]:
        """Every packet in order. Raises the damage, if any, after the last good one."""
        for entry in list(self.entries):
            yield entry, self.read(entry)
        if self.damage is not None:
            raise self.damage

    def check(self) -> None:
        """Verify every checksum and the index. Raises PacketError; an unfinished tail is not an error."""
        for entry, data in self:
            if entry.kind == PacketKind.INDEX and parse_index(data, entry.offset) != key_offsets(self.entries):
                raise PacketError("the index does not describe this stream", entry.offset)


def _check_order(entries: list[Entry], kind: PacketKind, frame: int, offset: int) -> None:
    if not entries:
        if kind != PacketKind.KEY:
            raise PacketError(f"expected a key packet first, got {kind.name.lower()}", offset)
        return
    last = entries[-1]
    if last.kind == PacketKind.INDEX:
        raise PacketError("a packet follows the index, which must be the last", offset)
    expected = last.frame if kind == PacketKind.INDEX else last.frame + 1
    if frame != expected:
        raise PacketError(f"frames must be consecutive: expected {expected} after {last.frame}, got {frame}", offset)


def key_offsets(entries: list[Entry]) -> list[tuple[int, int]]:
    """Return (frame, offset) of every key packet."""
    return [(entry.frame, entry.offset) for entry in entries if entry.kind == PacketKind.KEY]


def index_body(keys: list[tuple[int, int]], offset: int) -> bytes:
    """Return the body of the index section; its last 12 bytes say where the index packet begins."""
    return b"".join(_INDEX_ENTRY.pack(*key) for key in keys) + _INDEX_TRAILER.pack(offset, INDEX_MAGIC)


def parse_index(data: bytes, offset: int) -> list[tuple[int, int]]:
    """Return (frame, offset) of every key packet, from a complete index packet. Raises PacketError."""
    _, sections = parse_packet(data, offset)
    if set(sections) != {"index"}:
        raise PacketError(f"index packet: unexpected sections {sorted(sections)}", offset)
    section = sections["index"]
    size = len(section.data) - _INDEX_TRAILER.size
    if size < 0 or size % _INDEX_ENTRY.size:
        raise PacketError(f"index of {len(section.data)} bytes cannot be", section.offset)
    own, magic = _INDEX_TRAILER.unpack_from(section.data, size)
    if own != offset or magic != INDEX_MAGIC:
        raise PacketError("index trailer does not point at its packet", section.offset + size)
    return [(frame, at) for frame, at in _INDEX_ENTRY.iter_unpack(section.data[:size])]
