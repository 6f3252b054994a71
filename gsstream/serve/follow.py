"""Follow a stream file that grows, is begun again, or is not there yet."""

from __future__ import annotations

import json
import os
import socket
import stat
from pathlib import Path
from typing import NamedTuple

from gsstream.core.errors import PacketError, SourceError
from gsstream.engine.run.output import LOCK, RUN_FILES
from gsstream.packet import PacketKind, StreamReader
from gsstream.packet.base import FILE_HEADER, PACKET_HEADER
from gsstream.packet.reader import Entry

#: Frames whose time of writing is remembered.
_REMEMBERED = 512


class State(NamedTuple):
    """What a stream is doing: ``name`` is waiting, live, ended, stopped or damaged; ``detail`` a sentence or empty."""

    name: str
    detail: str = ""


class Follower:
    """The packets of a stream file as they are completed.

    ``generation`` rises whenever another stream begins in the file (it was replaced, or cut and written anew): packets
    that were read before do not lead to those that follow. ``entries`` are the frames' packets of this generation,
    ``keys`` the places of key packets in them. A packet that is only half written is not listed until it is whole.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Follow the file at ``path``; nothing is read before :meth:`look`."""
        self.path = Path(path)
        self.generation = 0
        self.keys: list[int] = []
        self.count = 0
        #: Frame -> time at which the file had its packet, in milliseconds since 1970; only of packets seen arriving.
        self.written: dict[int, float] = {}
        self._reader: StreamReader | None = None
        self._seen: os.stat_result | None = None
        self._header = b""
        self._unreadable = ""

    @property
    def entries(self) -> list[Entry]:
        """Packets in file order; the first ``count`` of them are frames, an index may follow."""
        return [] if self._reader is None else self._reader.entries

    @property
    def newest(self) -> int | None:
        """Number of the newest complete frame, or None."""
        return self.entries[self.count - 1].frame if self.count else None

    def close(self) -> None:
        """Close the file."""
        if self._reader is not None:
            self._reader.close()
            self._reader = None

    def look(self) -> bool:
        """Read the packets that were written since the last call. Returns whether anything changed."""
        try:
            seen = self.path.stat()
            if not stat.S_ISREG(seen.st_mode):
                raise FileNotFoundError  # a pipe would stop the server for as long as nobody writes into it
        except OSError:
            changed, self._seen = self._seen is not None, None
            return changed
        before, self._seen = self._seen, seen
        if before is not None and _same(before, seen):
            return False
        replaced = before is None or not os.path.samestat(before, seen)
        if self._reader is None or replaced or not self._goes_on(seen.st_size):
            self._begin(seen.st_size)
        elif self._reader is not None:
            self._grow(seen.st_mtime_ns / 1e6)
        return True

    def read(self, entry: Entry) -> bytes:
        """Return all bytes of a packet. Raises PacketError when they are damaged or gone."""
        if self._reader is None:
            raise PacketError("the stream is gone", entry.offset)
        return self._reader.read(entry)

    def header(self) -> bytes:
        """Return the first bytes of the file, which say which format it has."""
        with self.path.open("rb") as file:
            return file.read(FILE_HEADER.size)

    def state(self) -> State:
        """Return the state of the stream."""
        if self._seen is None:
            return State("waiting", "The stream is not there yet.")
        if self._reader is None:
            return State("damaged", self._unreadable) if self._unreadable else State("waiting", "")
        if self._reader.damage is not None:
            return State("damaged", str(self._reader.damage))
        if len(self.entries) > self.count:
            return State("ended")
        if writer_is_gone(self.path.parent):
            return State("stopped", "The encoder stopped before the stream was finished.")
        return State("live") if self.count else State("waiting", "No frame is encoded yet.")

    def _goes_on(self, size: int) -> bool:
        """Return whether the file still begins with the bytes that were read from it."""
        if not self.count:
            return True
        last = self.entries[self.count - 1]
        if size < last.offset + last.size:
            return False
        try:
            return self.read(last)[: PACKET_HEADER.size] == self._header
        except PacketError:
            return not self._header  # the packet was damaged when it came

    def _begin(self, size: int) -> None:
        self.close()
        self.keys, self.count, self.written, self._unreadable = [], 0, {}, ""
        try:
            self._reader = StreamReader(self.path)
        except SourceError:
            self._seen = None
        except PacketError as error:
            # The first bytes of a stream may still be on their way.
            self._unreadable = str(error) if size >= FILE_HEADER.size else ""
        else:
            self.generation += 1
            self._list()

    def _grow(self, now: float) -> None:
        assert self._reader is not None
        known = self.count
        self._reader.refresh()
        self._list()
        for entry in self.entries[known : self.count]:
            self.written[entry.frame] = now
        while len(self.written) > _REMEMBERED:
            del self.written[next(iter(self.written))]

    def _list(self) -> None:
        known, entries = self.count, self.entries
        self.count = len(entries) - (bool(entries) and entries[-1].kind == PacketKind.INDEX)
        self.keys += [i for i in range(known, self.count) if entries[i].kind == PacketKind.KEY]
        if self.count > known:
            try:
                self._header = self.read(entries[self.count - 1])[: PACKET_HEADER.size]
            except PacketError:
                self._header = b""


def writer_is_gone(folder: Path) -> bool:
    """Return True when the run that wrote ``folder`` has no running encoder: it was killed, or it failed.

    False also when that is unknown: no run wrote here, or one on another machine does.
    """
    try:
        holder = json.loads((folder / LOCK).read_text(encoding="utf-8"))
        if holder["host"] != socket.gethostname():
            return False
        os.kill(int(holder["pid"]), 0)
    except ProcessLookupError:
        return True
    except FileNotFoundError:
        # A run lets go of its folder when it ends. A stream that another program writes has no such files beside it.
        return any((folder / name).exists() for name in RUN_FILES[1:])
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return False


def _same(before: os.stat_result, after: os.stat_result) -> bool:
    return (
        os.path.samestat(before, after) and before.st_size == after.st_size and before.st_mtime_ns == after.st_mtime_ns
    )
