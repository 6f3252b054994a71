"""``gsstream open``: a stream in the browser, recorded or as it is written."""

from __future__ import annotations

import os
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gsstream.cli.streams import stream_file
from gsstream.core.errors import InputError

if TYPE_CHECKING:
    from gsstream.serve.server import Server

#: Environment variable with the token: unlike an option it is not in the list of processes.
TOKEN = "GSSTREAM_TOKEN"
LOOPBACK = "127.0.0.1"


def open_stream(
    stream: Annotated[
        str, typer.Argument(help="A stream (.gss), the output folder of a run, or with --live ws://SERVER/live.")
    ],
    live: Annotated[
        bool, typer.Option("--live", help="Show the newest frame as it is written; the stream may come later.")
    ] = False,
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Port of the page; 0: any.")] = 0,
    host: Annotated[
        str, typer.Option("--host", help="Address to serve at; 0.0.0.0 lets other machines look.")
    ] = LOOPBACK,
    token: Annotated[
        str | None,
        typer.Option("--token", envvar=TOKEN, help="Only who adds ?token=TOKEN to the address may look."),
    ] = None,
    viewers: Annotated[int, typer.Option("--viewers", min=1, help="How many may watch live at a time.")] = 16,
    origin: Annotated[
        list[str] | None,
        typer.Option("--origin", metavar="URL", help="Another web page that may use the stream; repeatable."),
    ] = None,
) -> None:
    """Show a stream in the browser; Ctrl-C ends.

    A recorded stream on this machine alone needs no extra; --live, --host, --token and --origin need gsstream[serve].
    """
    from gsstream.serve.relay import is_upstream

    if is_upstream(stream):
        if not live:
            raise InputError(f"{stream.partition('?')[0]}: the socket of a live server is shown with --live")
        with relaying(stream) as relayed:
            _serve(relayed, live=True, host=host, port=port, token=token, viewers=viewers, origin=origin)
        return
    file = coming(Path(stream)) if live else stream_file(Path(stream))
    if not live and host == LOOPBACK and not token and not origin:
        from gsstream.serve.local import LocalServer

        with LocalServer(file, port) as local:
            _show(file, local.url)
            local.serve_forever()
        return
    _serve(file, live=live, host=host, port=port, token=token, viewers=viewers, origin=origin)


def _serve(
    file: Path,
    *,
    live: bool,
    host: str,
    port: int,
    token: str | None,
    viewers: int,
    origin: list[str] | None,
) -> None:
    from gsstream.serve.server import Server

    server = Server(
        file, live=live, host=host, port=port, token=token or None, origins=origin or (), max_viewers=viewers
    )
    _show(file, server.url, browser=host == LOOPBACK)
    server.run()


@contextmanager
def relaying(address: str) -> Iterator[Path]:
    """Give the file in which the stream of another live server is while this is open, from its newest key packet on."""
    from gsstream.serve.relay import Relay

    with tempfile.TemporaryDirectory(prefix="relay-") as folder:
        path = Path(folder) / "relayed.gss"
        with Relay(address, path, lambda line: typer.echo(f"note: {line}", err=True)):
            yield path


def _show(file: Path, url: str, *, browser: bool = True) -> None:
    typer.echo(f"{file}: {url} (Ctrl-C ends)")
    if browser:
        import webbrowser

        # In a thread beside the server: a browser that runs in the terminal returns only when the user leaves it.
        threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()


def server_beside(out: Path, port: int | None) -> Server | None:
    """Take the address for ``run --serve``: what a run writes to ``out``, shown on this machine alone.

    To be called before the folder is touched: a port in use must not cost the run that it holds.
    """
    if port is None:
        return None
    from gsstream.serve.server import Server

    return Server(out / "stream.gss", live=True, port=port, token=os.environ.get(TOKEN) or None)


@contextmanager
def serving(server: Server | None) -> Iterator[None]:
    """Serve the run while it goes on, and print the address."""
    if server is None:
        yield
        return
    with server:
        typer.echo(f"live at {server.url}")
        yield


def coming(stream: Path) -> Path:
    """Return the file that a run will write, when ``stream`` is its folder; else ``stream``."""
    return stream if stream.suffix == ".gss" and not stream.is_dir() else stream / "stream.gss"
