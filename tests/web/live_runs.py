"""Live streams under test: servers and writers as processes of their own, a browser that is told step by step."""

from __future__ import annotations

import contextlib
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from browser_runs import CHROMIUM
from node_runs import HERE, NODE

from gsstream.packet import EncodedPacket, PacketKind, decode_packet
from gsstream.packet.base import file_header

websockets = pytest.importorskip("websockets", reason="starlette, uvicorn or websockets (extra serve) is missing")
pytest.importorskip("uvicorn", reason="starlette, uvicorn or websockets (extra serve) is missing")
pytest.importorskip("starlette", reason="starlette, uvicorn or websockets (extra serve) is missing")

HEADER = file_header()


class Page:
    """A browser with one page. Every step returns what it gave and fails the test when the browser says so."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        self.messages: list[str] = []

    def __getattr__(self, name: str) -> Any:
        return lambda *arguments: self._step([name, *arguments])

    def _step(self, step: Sequence[Any]) -> Any:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(step) + "\n")
        self._process.stdin.flush()
        answer = json.loads(self._process.stdout.readline())
        self.messages += answer["messages"]
        assert "error" not in answer, answer
        return answer["value"]


@contextlib.contextmanager
def browsing(width: int = 160, height: int = 120) -> Iterator[Page]:
    """A browser for several steps or tests."""
    command = [str(NODE), str(HERE / "interactive.mjs"), str(CHROMIUM), str(width), str(height)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield Page(process)
        finally:
            assert process.stdin is not None
            process.stdin.close()
            process.wait(timeout=30)


@contextlib.contextmanager
def served(*arguments: object, **environment: str) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """``gsstream open`` as a process; yields the address that it prints and the process."""
    command = [sys.executable, "-c", "from gsstream.cli.main import main; main()", "open", *map(str, arguments)]
    settings = os.environ | {"BROWSER": "true"} | environment
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=settings) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            found = re.search(r"http://\S+", line)
            assert found, line + (process.stderr.read() if process.stderr else "")
            yield found[0], process
        finally:
            process.terminate()
            process.wait(timeout=20)


class Growing:
    """A stream file that a test writes packet by packet."""

    def __init__(self, path: Path) -> None:
        self.file = path.open("wb", buffering=0)
        self.file.write(HEADER)

    def write(self, packets: Sequence[EncodedPacket], pause: float = 0.0) -> None:
        for packet in packets:
            self.file.write(packet.data)
            time.sleep(pause)


def live_socket(url: str, **settings: Any) -> Any:
    """A viewer that is no browser."""
    from websockets.sync.client import connect

    address, _, query = url.partition("?")
    return connect(
        address.replace("http", "ws", 1) + "live" + (f"?{query}" if query else ""),
        compression=None,
        max_size=None,
        proxy=None,
        open_timeout=60,
        **settings,
    )


def packets_from(
    socket: Any, *, until: int | None = None, seconds: float = 20, into: list[bytes] | None = None
) -> tuple[list[bytes], list[dict]]:
    """Binary messages (also ``into`` a list) and texts, until the packet of frame ``until`` or the stream's end."""
    binary = [] if into is None else into
    texts: list[dict] = []
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        message = socket.recv(timeout=max(0.01, end - time.monotonic()))
        if isinstance(message, bytes):
            binary.append(message)
            if until is not None and frame_of(message) == until:
                return binary, texts
        else:
            texts.append(json.loads(message))
            if until is None and texts[-1].get("state") == "ended":
                return binary, texts
    raise AssertionError(f"frame {until} did not come within {seconds} s: {texts[-3:]}")


def frame_of(packet: bytes) -> int | None:
    """Frame number of a packet; None for the header of a stream."""
    return None if packet == HEADER else int.from_bytes(packet[4:8], "little")


def assert_playable(messages: Sequence[bytes]) -> list[int]:
    """What a viewer got must begin with a header and a key packet, and no delta may lack the frame before it.

    Returns the frames, each of which is decoded.
    """
    assert messages[0] == HEADER
    state, frames = None, []
    for packet in messages[1:]:
        if packet == HEADER:
            state = None
            continue
        state = decode_packet(None if packet[0] == PacketKind.KEY else state, packet)
        frames.append(frame_of(packet))
    return frames
