"""The web application: the page, the stream by byte ranges, and the socket of a live stream. Nothing else is served."""

from __future__ import annotations

import asyncio
import contextlib
import hmac
from collections.abc import AsyncIterator
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from gsstream.packet import FORMAT_VERSION
from gsstream.serve.follow import Follower
from gsstream.serve.hub import Hub

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import HTTPConnection, Request
    from starlette.responses import Response
    from starlette.websockets import WebSocket

#: Bytes of the longest address that is answered.
MAX_ADDRESS = 4096
STREAM, MANIFEST, SOCKET = "/stream.gss", "/stream.json", "/live"


@dataclass(frozen=True)
class Rules:
    """Who may look: with which token, from which other pages (origins), by which names of this server (hosts).

    None: anyone. A page elsewhere that gives itself the address of this machine is kept out by ``hosts``.
    """

    token: str | None = None
    origins: tuple[str, ...] = ()
    hosts: tuple[str, ...] | None = None

    def refusal(self, request: HTTPConnection, *, guarded: bool) -> tuple[int, str] | None:
        """Return status and sentence with which a request is refused, or None."""
        try:
            name = urlsplit(f"//{request.headers.get('host', '')}").hostname
            urlsplit(request.headers.get("origin", ""))
        except ValueError:
            return 400, "The Host or the Origin of this request is no name of a server."
        if len(request.scope.get("raw_path", b"")) + len(request.scope["query_string"]) > MAX_ADDRESS:
            return 414, "The address is too long."
        if self.hosts is not None and name not in self.hosts:
            return 403, "This server does not answer to that name."
        if guarded and self.token is not None:
            given = request.query_params.get("token", "")
            if not hmac.compare_digest(given.encode(), self.token.encode()):
                return 401, "This stream needs a token: add ?token=... to the address."
        return None

    def foreign(self, request: HTTPConnection) -> bool:
        """Say whether a browser asks for a page from elsewhere. Programs other than browsers name no origin."""
        origin = request.headers.get("origin")
        if origin is None or origin in self.origins:
            return False
        return bool(urlsplit(origin).netloc != request.headers.get("host"))


def make_app(stream: Path, *, live: bool, rules: Rules, max_viewers: int, hub_of: list[Hub]) -> Starlette:
    """Return the application that serves a stream."""
    from starlette.applications import Starlette
    from starlette.middleware import Middleware
    from starlette.middleware.cors import CORSMiddleware
    from starlette.routing import Mount, Route, WebSocketRoute
    from starlette.staticfiles import StaticFiles

    follower = Follower(stream)

    @contextlib.asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        hub = Hub(follower, max_viewers=max_viewers)
        follower.look()
        hub_of.append(hub)
        looking = asyncio.create_task(hub.run())
        try:
            yield
        finally:
            looking.cancel()
            await asyncio.gather(looking, return_exceptions=True)
            follower.close()

    async def manifest(_: Request) -> Response:
        return _manifest(follower, live=live)

    async def file(_: Request) -> Response:
        return _file(stream)

    async def socket(websocket: WebSocket) -> None:
        if rules.foreign(websocket):
            await _refuse(websocket, 403, "This page may not use the stream: name it to the server with --origin.")
            return
        await websocket.accept()
        await hub_of[-1].watch(websocket, _after(websocket))

    return Starlette(
        routes=[
            Route(MANIFEST, manifest),
            Route(STREAM, file),
            WebSocketRoute(SOCKET, socket),
            Mount("/", StaticFiles(directory=str(resources.files("gsstream") / "web"), html=True)),
        ],
        middleware=[
            Middleware(
                CORSMiddleware,
                allow_origins=list(rules.origins),
                allow_headers=["Range"],
                expose_headers=["Content-Range", "ETag"],
            ),
            Middleware(_Guard, rules=rules),
        ],
        lifespan=lifespan,
    )


class _Guard:
    """Refuses requests that the rules do not allow, before any other handler; adds headers on the use of answers."""

    HEADERS = (
        (b"cache-control", b"no-cache"),
        (b"x-content-type-options", b"nosniff"),
        # The address may hold the token.
        (b"referrer-policy", b"no-referrer"),
    )

    def __init__(self, app: Any, rules: Rules) -> None:
        self.app, self.rules = app, rules

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        from starlette.requests import HTTPConnection
        from starlette.responses import PlainTextResponse
        from starlette.websockets import WebSocket

        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        refusal = self.rules.refusal(HTTPConnection(scope), guarded=scope["path"] in (STREAM, MANIFEST, SOCKET))

        async def marked(message: Any) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message["headers"], *self.HEADERS]
            await send(message)

        if refusal is None:
            await self.app(scope, receive, marked)
        elif scope["type"] == "websocket":
            await _refuse(WebSocket(scope, receive, send), *refusal)
        else:
            await PlainTextResponse(refusal[1], refusal[0])(scope, receive, marked)


async def _refuse(websocket: WebSocket, status: int, why: str) -> None:
    from starlette.responses import PlainTextResponse

    await websocket.send_denial_response(PlainTextResponse(why, status))


def _after(websocket: WebSocket) -> tuple[int, bytes] | None:
    """The packet that a returning viewer says it has, ``after=FRAME&packet=HEX``; None when the address holds none."""
    given = websocket.query_params
    try:
        return int(given["after"][:12]), bytes.fromhex(given["packet"][:64])
    except (KeyError, ValueError):
        return None


def _manifest(follower: Follower, *, live: bool) -> Response:
    """Return the player's configuration: the socket of a live stream, or the segments of a recording."""
    from starlette.responses import JSONResponse, PlainTextResponse

    if live:
        return JSONResponse({"format": f"gsstream {FORMAT_VERSION}", "live": SOCKET.removeprefix("/")})
    frames = follower.entries[: follower.count]
    if not frames:
        return PlainTextResponse("There is no complete frame yet.", 404)
    ends = [*follower.keys[1:], follower.count]
    segments = [
        # The first segment begins with the file header, by which a reader knows the format.
        {
            "frames": [frames[start].frame, frames[stop - 1].frame],
            "range": [frames[start].offset if start else 0, frames[stop - 1].offset + frames[stop - 1].size - 1],
        }
        for start, stop in zip(follower.keys, ends, strict=True)
    ]
    return JSONResponse(
        {
            "format": f"gsstream {FORMAT_VERSION}",
            "file": STREAM.removeprefix("/"),
            "frames": len(frames),
            "first_frame": frames[0].frame,
            "segments": segments,
        }
    )


def _file(stream: Path) -> Response:
    """The stream as it is now, or the part that is asked for."""
    from starlette.responses import FileResponse, PlainTextResponse

    if not stream.is_file():
        return PlainTextResponse("There is no stream yet.", 404)
    return FileResponse(stream, media_type="application/octet-stream")
