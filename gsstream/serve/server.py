"""A web server for one stream, in the foreground or beside a run in the same process (extra ``serve``)."""

from __future__ import annotations

import asyncio
import importlib.util
import os
import socket
import threading
import warnings
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING
from urllib.parse import quote, urlsplit

from gsstream.core.errors import InputError, OutputError
from gsstream.core.install_hints import install_extra
from gsstream.serve.app import Rules, make_app
from gsstream.serve.local import HOST as LOOPBACK

if TYPE_CHECKING:
    from gsstream.serve.hub import Hub

_LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")
#: Bytes that the system may hold back for a viewer who has not taken earlier ones, and milliseconds after which a
#: viewer that takes nothing is cut off. Both are set where the system knows such limits.
_UNSENT, _TIMEOUT_MS = 128 << 10, 60_000
#: Largest message of a viewer; it only asks for the time.
_MAX_MESSAGE_BYTES = 1024


class Server:
    """Serves the page, the stream and, as it grows, its packets. The address is taken at once; see ``url``.

    Use :meth:`run`, or the server as a context manager, which serves from a thread of its own.
    """

    def __init__(
        self,
        stream: str | os.PathLike[str],
        *,
        live: bool = False,
        host: str = LOOPBACK,
        port: int = 8000,
        token: str | None = None,
        origins: Sequence[str] = (),
        max_viewers: int = 16,
    ) -> None:
        """Take the address.

        Raises InputError without starlette and uvicorn or for an impossible origin, OutputError when nothing can be
        served at this address.
        """
        for name in ("starlette", "uvicorn", "websockets"):
            if importlib.util.find_spec(name) is None:
                cure = f"{install_extra('serve')}; or use gsstream export --format page"
                raise InputError(f"serving needs {name}: {cure}")
        names = [_checked_origin(origin) for origin in origins]
        loopback = host in _LOOPBACK_NAMES
        if not loopback and token is None:
            warnings.warn(f"everybody who reaches {host} may look; --token lets in only who knows it", stacklevel=2)
        hosts = (*_LOOPBACK_NAMES, *names) if loopback else None
        self.token, self.max_viewers = token, max_viewers
        self._hubs: list[Hub] = []
        self.app = make_app(
            Path(stream),
            live=live,
            rules=Rules(token, tuple(origins), hosts),
            max_viewers=max_viewers,
            hub_of=self._hubs,
        )
        self._socket = _listen(host, port)
        self.host, self.port = host, self._socket.getsockname()[1]
        self._thread: threading.Thread | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stop = threading.Event()

    @property
    def url(self) -> str:
        """Where the page is."""
        name = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{name}:{self.port}/" + (f"?token={quote(self.token)}" if self.token is not None else "")

    def run(self) -> None:
        """Serve until Ctrl-C or SIGTERM."""
        asyncio.run(self._serve())

    def close(self, drain: float = 0.0) -> None:
        """Stop serving. ``drain``: seconds in which viewers may still receive their remaining packets."""
        if self._thread is not None:
            hub = self._hubs[-1] if self._hubs else None
            if drain and hub is not None and self._loop is not None:
                asyncio.run_coroutine_threadsafe(hub.drained(drain), self._loop).result()
            self._stop.set()
            self._thread.join()
            self._thread = None
        self._socket.close()

    def __enter__(self) -> Server:
        ready = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve(ready)), name="serve", daemon=True)
        self._thread.start()
        ready.wait()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close(drain=5.0 if kind is None else 0.0)

    async def _serve(self, ready: threading.Event | None = None) -> None:
        import uvicorn

        from gsstream.serve.patience import Patience, guarded

        patience = Patience()
        config = uvicorn.Config(
            self.app,
            log_config=None,
            access_log=False,
            log_level="error",  # whoever sends nonsense gets an answer, and the terminal no line
            lifespan="on",
            server_header=False,
            http=guarded(patience),
            ws="websockets-sansio",
            ws_max_size=_MAX_MESSAGE_BYTES,
            ws_per_message_deflate=False,
            ws_ping_interval=20,
            ws_ping_timeout=60,
            limit_concurrency=4 * self.max_viewers + 64,
            timeout_graceful_shutdown=1,
        )
        server = uvicorn.Server(config)
        self._loop = asyncio.get_running_loop()
        waiting = asyncio.create_task(patience.run())
        task = asyncio.create_task(server.serve(sockets=[self._socket]))
        if ready is not None:
            while not server.started and not task.done():
                await asyncio.sleep(0.005)
            ready.set()
            await self._loop.run_in_executor(None, self._stop.wait)
            server.should_exit = True
        try:
            await task
        finally:
            waiting.cancel()


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        # Connections inherit both. What the system holds back is old by the time that a slow viewer takes it.
        if hasattr(socket, "TCP_NOTSENT_LOWAT"):
            listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, _UNSENT)
        if hasattr(socket, "TCP_USER_TIMEOUT"):
            listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _TIMEOUT_MS)
        listener.bind((host, port))
        # At once: clients may connect before the server is ready, and no other server can take the port.
        listener.listen(128)
    except OSError as error:
        listener.close()
        raise OutputError(f"cannot serve at {host}:{port}: {error.strerror or error}") from error
    return listener


def _checked_origin(origin: str) -> str:
    """Return the host of an origin. Raises InputError."""
    parts = urlsplit(origin)
    if parts.scheme not in ("http", "https") or not parts.hostname or origin != f"{parts.scheme}://{parts.netloc}":
        raise InputError(f"--origin {origin}: expected scheme://host[:port] of a web page, e.g. https://example.org")
    return parts.hostname
