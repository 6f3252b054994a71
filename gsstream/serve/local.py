"""A recorded stream and its page for a browser on this machine: Python's own web server, no extra."""

from __future__ import annotations

import sys
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from pathlib import Path
from urllib.parse import urlsplit

from gsstream.core.errors import OutputError

HOST = "127.0.0.1"


class LocalServer(ThreadingHTTPServer):
    """Serves the page and one stream, on loopback. The address is taken at once; see ``url``."""

    def __init__(self, stream: Path, port: int = 0) -> None:
        """Take the address; port 0 is any that is free. Raises OutputError when it is in use."""
        handler = partial(_Handler, stream, directory=str(resources.files("gsstream") / "web"))
        try:
            super().__init__((HOST, port), handler)
        except OSError as error:
            raise OutputError(f"cannot serve at {HOST}:{port}: {error.strerror or error}") from error
        self.url = f"http://{HOST}:{self.server_port}/?src=stream.gss"

    def handle_error(self, request: object, client_address: object) -> None:
        """A browser that leaves in the middle of an answer is no error."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)  # type: ignore[arg-type]


class _Handler(SimpleHTTPRequestHandler):
    extensions_map = SimpleHTTPRequestHandler.extensions_map | {".js": "text/javascript"}

    def __init__(self, stream: Path, *arguments: object, **settings: object) -> None:
        self.stream = stream
        super().__init__(*arguments, **settings)  # type: ignore[arg-type]

    def parse_request(self) -> bool:
        """Refuse other names: a page elsewhere may give itself the address of this machine."""
        if not super().parse_request():
            return False
        try:
            name = urlsplit(f"//{self.headers.get('Host', '')}").hostname
        except ValueError:
            self.send_error(400, "The Host of this request is no name of a server")
            return False
        if name in (HOST, "localhost"):
            return True
        self.send_error(403, "This server does not answer to that name")
        return False

    def translate_path(self, path: str) -> str:
        if path.partition("?")[0].partition("#")[0] == "/stream.gss":
            return str(self.stream)
        return super().translate_path(path.replace("%00", "_"))

    def list_directory(self, path: object) -> None:
        self.send_error(404)

    def end_headers(self) -> None:
        self.send_header("Cache-Control", "no-cache")
        super().end_headers()

    def log_message(self, *_: object) -> None:
        """Say nothing: the terminal shows the address."""
