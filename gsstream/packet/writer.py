"""StreamWriter: appends packets; every packet is flushed before the call returns."""

from __future__ import annotations

import os
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from gsstream.core.errors import OutputError, PacketError
from gsstream.packet.base import FORMAT_VERSION, PACKET_HEADER, EncodedPacket, PacketKind, build_packet, file_header
from gsstream.packet.reader import Entry, StreamReader, index_body, key_offsets


class StreamWriter:
    """An open stream. Use :meth:`open`; as a context manager it writes the index unless an exception passes."""

    def __init__(self, file: BinaryIO, entries: list[Entry], offset: int) -> None:
        self._file, self.entries, self._offset = file, entries, offset

    @classmethod
    def open(cls, path: str | os.PathLike[str], *, resume: bool = False, last_frame: int | None = None) -> StreamWriter:
        """Begin a stream, or with ``resume`` go on with an existing one.

        Resuming verifies every packet, cuts an unfinished or torn last packet and the index off, and with
        ``last_frame`` every packet after that frame (a checkpoint may be older than the stream).

        Every packet reaches the operating system before the call that wrote it returns: a killed process loses none.

        Arguments:
            path: of the stream.
            resume: go on with the stream that is there.
            last_frame: go on after this frame; None: after the last sound packet.

        Raises OutputError when the file exists (or, with ``resume``, cannot be opened), PacketError when it is damaged
        before its last packet: nothing is cut then.
        """
        path = Path(path)
        file: BinaryIO
        try:
            if not resume or not path.exists() or path.stat().st_size < len(file_header()):
                file = path.open("wb" if resume else "xb")
                writer = cls(file, [], 0)
                writer._write(file_header())
                return writer
            entries, end = _valid_part(path, last_frame)
            file = path.open("r+b")
        except FileExistsError as error:
            raise OutputError(f"{path} exists; resume it or choose another place") from error
        except OSError as error:
            raise OutputError(f"cannot write the stream {path}: {error.strerror}") from error
        file.truncate(end)
        file.seek(end)
        return cls(file, entries, end)

    def __enter__(self) -> StreamWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close(index=kind is None)

    @property
    def next_frame(self) -> int | None:
        """Frame the next packet must have; None when the stream is empty (any key packet may begin it)."""
        return self.entries[-1].frame + 1 if self.entries else None

    def append(self, packet: EncodedPacket) -> int:
        """Write a packet and return its number of bytes. Raises PacketError when it is out of turn."""
        wanted = self.next_frame
        if packet.kind == PacketKind.INDEX or (wanted is None and packet.kind != PacketKind.KEY):
            raise PacketError(f"a stream begins with a key packet and takes no {packet.kind.name.lower()} packet here")
        if wanted is not None and packet.frame != wanted:
            raise PacketError(f"frames must be consecutive: expected {wanted}, got {packet.frame}")
        entry = Entry(packet.kind, packet.frame, self._offset, len(packet.data))
        self._write(packet.data)
        self.entries.append(entry)
        return entry.size

    def close(self, *, index: bool = True) -> None:
        """Write the index (so that clients find key packets by one range request) and close."""
        if self._file.closed:
            return
        if index and self.entries:
            body = index_body(key_offsets(self.entries), self._offset)
            self._write(build_packet(PacketKind.INDEX, self.entries[-1].frame, [("index", body)]).data)
        self._file.close()

    def _write(self, data: bytes) -> None:
        self._file.write(data)
        self._file.flush()
        self._offset += len(data)


def _valid_part(path: Path, last_frame: int | None) -> tuple[list[Entry], int]:
    """Packets to keep and the byte after them."""
    with StreamReader(path) as reader:
        if reader.version != FORMAT_VERSION:
            raise OutputError(
                f"{path} is of packet format {reader.version}, this gsstream writes {FORMAT_VERSION}: it can be played "
                "but not continued; start again in another place"
            )
        # A header of which only the beginning was written has reserved zeros behind it, and no body.
        torn = path.stat().st_size > reader.end + PACKET_HEADER.size and _blank(path, reader.end + PACKET_HEADER.size)
        if reader.damage is not None and not torn and not _blank(path, reader.end):
            raise reader.damage
        for entry in reader.entries:
            try:
                reader.read(entry)
            except PacketError:
                # A power cut can leave the last packet at full length with blocks that never reached the disk, and
                # zeros behind it that were reserved for the next one.
                if entry is not reader.entries[-1] or not _blank(path, entry.offset + entry.size):
                    raise
                reader.entries.pop()
                break
        kept = [e for e in reader.frames if last_frame is None or e.frame <= last_frame]
        if last_frame is not None and reader.frames and (not kept or kept[-1].frame < last_frame):
            raise OutputError(f"{path} ends before frame {last_frame}; the checkpoint belongs to another stream")
        return kept, kept[-1].offset + kept[-1].size if kept else len(file_header())


def _blank(path: Path, start: int) -> bool:
    """Whether the file holds nothing but zeros from ``start`` on (space reserved, never written)."""
    with path.open("rb") as file:
        file.seek(start)
        while chunk := file.read(1 << 16):
            if chunk.strip(b"\0"):
                return False
    return True
