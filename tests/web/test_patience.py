"""A server under connections that say nothing, say it badly, or ask for what is no file: it answers everybody else."""

from __future__ import annotations

import asyncio
import os
import socket
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from live_runs import live_socket, packets_from
from moving_scenes import moving_packets

from gsstream.packet import StreamWriter
from gsstream.serve import patience
from gsstream.serve.follow import Follower
from gsstream.serve.local import LocalServer
from gsstream.serve.server import Server


@pytest.fixture(scope="module")
def stream(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("served") / "stream.gss"
    with StreamWriter.open(path) as writer:
        for packet in moving_packets(seed=3, frames=4, number=40, nodes=10, key_at=2):
            writer.append(packet)
    return path


@pytest.fixture
def url(stream: Path) -> Iterator[str]:
    with Server(stream, live=True, port=0) as server:
        yield server.url


def connect(url: str) -> socket.socket:
    parts = urlsplit(url)
    return socket.create_connection((parts.hostname, parts.port), timeout=20)


def ask(url: str, request: bytes) -> bytes:
    """The first line of the answer to these bytes."""
    with connect(url) as connection:
        connection.sendall(request)
        return connection.recv(4096).partition(b"\r\n")[0]


def whole(url: str) -> int:
    with urllib.request.urlopen(url, timeout=20) as answer:
        return answer.status


def test_five_hundred_silent_connections_shut_nobody_out(url: str) -> None:
    with ExitStack() as held:
        silent = [held.enter_context(connect(url)) for _ in range(500)]
        for connection in silent[::2]:
            with suppress(OSError):  # closed already, as one of the oldest
                connection.sendall(b"GET / HTTP/1.1\r\nHost: local")
        assert whole(url) == 200
        with live_socket(url) as viewer:
            packets_from(viewer, until=3)
        assert ask(url, b"GET /stream.json HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n") == b"HTTP/1.1 200 OK"
        # The youngest of them still wait for their turn; the oldest made room for them.
        silent[-1].sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert silent[-1].recv(100).startswith(b"HTTP/1.1 200")
        with suppress(ConnectionError):
            assert silent[0].recv(100) == b""


def test_a_header_that_never_ends_has_its_time(stream: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also the second one of a connection; a viewer that says nothing stays."""
    monkeypatch.setattr(patience, "_LOOK", 0.02)
    monkeypatch.setattr(patience.Patience.__init__, "__defaults__", (0.3, 64))
    with Server(stream, live=True, port=0) as server, live_socket(server.url) as viewer, connect(server.url) as slow:
        packets_from(viewer)
        slow.sendall(b"GET /stream.json HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert slow.recv(10_000).startswith(b"HTTP/1.1 200")
        closed = False
        for _ in range(400):  # a byte now and then
            try:
                slow.sendall(b"G")
                time.sleep(0.02)
            except OSError:
                closed = True
                break
        assert closed
        viewer.send('{"ping": 1}')
        assert "pong" in viewer.recv(timeout=20)


MALFORMED = {
    "host": b"GET / HTTP/1.1\r\nHost: [::1\r\n\r\n",
    "origin": b"GET / HTTP/1.1\r\nHost: localhost\r\nOrigin: http://[\r\n\r\n",
    "socket's host": b"GET /live HTTP/1.1\r\nHost: [\r\nUPGRADE\r\n\r\n",
    "socket's origin": b"GET /live HTTP/1.1\r\nHost: localhost\r\nOrigin: http://[\r\nUPGRADE\r\n\r\n",
}
UPGRADE = (
    b"Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA=="
)


@pytest.mark.parametrize("what", MALFORMED)
def test_a_malformed_host_or_origin_is_answered_in_silence(
    url: str, what: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert ask(url, MALFORMED[what].replace(b"UPGRADE", UPGRADE)) == b"HTTP/1.1 400 Bad Request"
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("size", [5_000, 9_000, 40_000])
@pytest.mark.parametrize("path", [b"/", b"/stream.gss", b"/live"])
def test_a_long_address_is_answered(url: str, path: bytes, size: int, capfd: pytest.CaptureFixture[str]) -> None:
    upgrade = UPGRADE + b"\r\n" if path == b"/live" else b""
    request = b"GET %s?%s HTTP/1.1\r\nHost: localhost\r\n%s\r\n" % (path, b"x" * size, upgrade)
    assert ask(url, request).startswith(b"HTTP/1.1 414 ")
    assert capfd.readouterr().err == ""


def test_a_long_header_of_a_socket_is_answered(url: str) -> None:
    long = b"X: " + b"x" * 9_000
    for more in (long, b"\r\n".join(b"X%d: y" % number for number in range(150))):
        request = b"GET /live HTTP/1.1\r\nHost: localhost\r\n" + more + b"\r\n" + UPGRADE + b"\r\n\r\n"
        assert ask(url, request).startswith(b"HTTP/1.1 431 ")


def test_a_pipe_in_the_place_of_the_stream_stops_nobody(tmp_path: Path, stream: Path) -> None:
    path = tmp_path / "stream.gss"
    os.mkfifo(path)
    with Server(path, live=True, port=0) as server:
        assert whole(server.url) == 200
        with live_socket(server.url) as viewer:
            assert '"waiting"' in viewer.recv(timeout=20)
            path.unlink()
            path.write_bytes(stream.read_bytes())
            packets_from(viewer, until=3)


def test_what_is_no_file_is_no_stream(tmp_path: Path) -> None:
    follower = Follower(tmp_path)
    assert not follower.look()
    assert follower.state().name == "waiting"


def test_the_server_of_one_machine_answers_a_malformed_host(stream: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with LocalServer(stream) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            assert ask(server.url, MALFORMED["host"]).startswith(b"HTTP/1.0 400 ")
            assert ask(server.url, b"GET //[ HTTP/1.1\r\nHost: localhost\r\n\r\n").startswith(b"HTTP/1.0 404 ")
        finally:
            server.shutdown()
            thread.join()
    assert capfd.readouterr().err == ""


def test_patience_is_over_for_the_oldest_first() -> None:
    class Connection:
        busy, aborted = False, False

        def __init__(self) -> None:
            self.transport = self

        def abort(self) -> None:
            self.aborted = True

    async def try_it() -> list[bool]:
        waiting, made = patience.Patience(most=2), [Connection() for _ in range(5)]
        made[1].busy = True
        for connection in made:
            waiting.arrived(connection)
        return [connection.aborted for connection in made]

    assert asyncio.run(try_it()) == [True, False, True, False, False]
