"""Connections that say nothing: how long the server waits for a request, and how many may wait at a time."""

from __future__ import annotations

import asyncio
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from gsstream.serve.app import MAX_ADDRESS

#: Seconds that a connection may take for the header of a request, and how many connections may be without a request.
HEADER_SECONDS, MOST_SILENT = 10.0, 64
#: Bytes of a header, and number of headers, that a request for a web socket may have; the parser itself drops a longer
#: one without an answer.
MAX_HEADER, MAX_HEADERS = 8000, 100
#: Seconds between two looks at the clock.
_LOOK = 0.5


class Patience:
    """The connections of one server that have no request in work, oldest first. Lives on one event loop.

    One that stays silent for too long is closed, and where too many are silent, the one that has been so for longest:
    whoever opens connections and sends nothing shuts nobody out but himself.
    """

    def __init__(self, seconds: float = HEADER_SECONDS, most: int = MOST_SILENT) -> None:
        self.seconds, self.most = seconds, most
        self._silent: dict[GuardedProtocol, float] = {}

    def arrived(self, connection: GuardedProtocol) -> None:
        """Begin to wait for a connection."""
        self._silent[connection] = asyncio.get_running_loop().time()
        waiting = [other for other in self._silent if not other.busy]
        for other in waiting[: max(0, len(waiting) - self.most)]:
            self._close(other)

    def left(self, connection: GuardedProtocol) -> None:
        """Forget a connection that is closed, or a socket by now."""
        self._silent.pop(connection, None)

    async def run(self) -> None:
        """Close what is silent for too long, until this task is cancelled."""
        while True:
            await asyncio.sleep(_LOOK)
            now = asyncio.get_running_loop().time()
            for connection, since in list(self._silent.items()):
                if connection.busy:
                    # Its next request has the whole time again, and it is the youngest of those that are silent then.
                    del self._silent[connection]
                    self._silent[connection] = now
                elif now - since > self.seconds:
                    self._close(connection)

    def _close(self, connection: GuardedProtocol) -> None:
        self.left(connection)
        connection.transport.abort()


class GuardedProtocol(H11Protocol):
    """HTTP/1.1 as uvicorn speaks it, with patience for silent connections and an answer to long addresses."""

    patience: Patience

    @property
    def busy(self) -> bool:
        """Whether a request is in work."""
        return self.cycle is not None and not self.cycle.response_complete

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self.patience.arrived(self)

    def connection_lost(self, exc: Exception | None) -> None:
        self.patience.left(self)
        super().connection_lost(exc)

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        if len(event.target) > MAX_ADDRESS:
            self._refuse(414, b"The address is too long.")
        elif len(self.headers) > MAX_HEADERS or any(len(key) + len(value) > MAX_HEADER for key, value in self.headers):
            self._refuse(431, b"The header is too long.")
        else:
            self.patience.left(self)
            super().handle_websocket_upgrade(event)

    def _refuse(self, status: int, why: bytes) -> None:
        headers = [("content-type", "text/plain; charset=utf-8"), ("content-length", str(len(why)))]
        answer = h11.Response(status_code=status, headers=[*headers, ("connection", "close")])
        for event in (answer, h11.Data(data=why), h11.EndOfMessage()):
            self.transport.write(self.conn.send(event))
        self.transport.close()


def guarded(patience: Patience) -> type[GuardedProtocol]:
    """Return the protocol of one server."""
    return type("GuardedProtocol", (GuardedProtocol,), {"patience": patience})
