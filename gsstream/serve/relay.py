"""A relay: a viewer of another live server, who writes what he gets into a file that viewers of his own are sent."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO
from urllib.parse import urlsplit

from gsstream.core.errors import InputError, PacketError
from gsstream.core.install_hints import install_extra
from gsstream.packet import PacketKind, StreamWriter
from gsstream.packet.base import MAGIC, MAX_BODY, PACKET_HEADER, parse_packet

#: Bytes after which a key packet begins the file anew.
LONGEST = 64 << 20
#: Seconds between two tries to connect.
PAUSES = (0.5, 1.0, 2.0, 4.0, 8.0)


def is_upstream(text: str) -> bool:
    """Return whether a text is the socket of a live server."""
    return text.startswith(("ws://", "wss://"))


class Relay:
    """Follows ``address`` and keeps ``path`` a stream that begins with one of its key packets.

    A file that is long begins anew with a key packet, and so does one after a gap: who follows it sees another stream
    begin, with the state that his own has come to. Raises InputError without websockets, or for an
    address that names no server.
    """

    def __init__(self, address: str, path: Path, say: Callable[[str], object]) -> None:
        try:
            import websockets  # noqa: F401
        except ImportError as error:
            raise InputError(f"a relay needs websockets: {install_extra('serve')}") from error
        if not urlsplit(address).hostname:
            raise InputError(f"{address.partition('?')[0]}: expected ws://SERVER/live, the socket of a live server")
        self.address, self.path, self.say = address, path, say
        self._stop = threading.Event()
        self._file: BinaryIO | None = None
        #: The header of the stream above, and the first bytes of the packet that came last, by which a server knows it.
        self._header, self._last = b"", b""
        self._frame, self._size = -1, 0
        self._thread = threading.Thread(target=self._run, name="relay", daemon=True)

    def __enter__(self) -> Relay:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._close()

    def _run(self) -> None:
        from websockets.exceptions import WebSocketException

        failures = 0
        while not self._stop.is_set():
            before = self._frame
            try:
                if self._follow():
                    return
            except (OSError, WebSocketException, PacketError) as error:
                failures = failures if self._frame == before else 0
                if failures == 0:
                    self.say(f"{self.address.partition('?')[0]}: {error}; trying again")
                self._stop.wait(PAUSES[min(failures, len(PAUSES) - 1)])
                failures += 1

    def _follow(self) -> bool:
        """Write what one connection brings; return whether the stream has ended, and False when the relay does."""
        from websockets.sync.client import connect

        address = self.address
        if self._last:
            address += f"{'&' if '?' in address else '?'}after={self._frame}&packet={self._last.hex()}"
        most = PACKET_HEADER.size + MAX_BODY
        with connect(address, compression=None, max_size=most, proxy=None, user_agent_header=None) as socket:
            while not self._stop.is_set():
                try:
                    message = socket.recv(timeout=0.5)
                except TimeoutError:
                    continue
                if isinstance(message, bytes):
                    self._take(message)
                elif json.loads(message).get("state") == "ended" and self._file is not None:
                    self._end()
                    return True
        return False

    def _take(self, data: bytes) -> None:
        if data.startswith(MAGIC):
            self._header = data
            return
        header, _ = parse_packet(data)
        follows = self._file is not None and header.frame == self._frame + 1
        if header.kind == PacketKind.KEY and not (follows and self._size < LONGEST):
            self._close()
            beside = self.path.with_name(f".{self.path.name}.next")
            file = beside.open("wb", buffering=0)
            file.write(self._header + data)
            beside.replace(self.path)
            self._file, self._size = file, 0
        elif self._file is None or not follows:
            raise PacketError(f"frame {header.frame} came without the one before it")
        else:
            self._file.write(data)
        self._size += len(data)
        self._frame, self._last = header.frame, data[: PACKET_HEADER.size]

    def _end(self) -> None:
        self._close()
        StreamWriter.open(self.path, resume=True).close()

    def _close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None
