"""How many viewers one live server serves: delay from packet to viewer, and memory, for a growing number of them.

Usage: python -m tools.viewers [--viewers 1 50 200 500] [--relays 0] [--seconds 8] [--fps 10] [--packet 3000]
                               [--out FILE.json]

A server in a process of its own, a writer that appends packets at a rate, and viewers in this process, all on loopback.
A viewer's delay is the time from the packet's last byte in the file to its last byte here.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from statistics import median, quantiles

import numpy as np
from websockets.asyncio.client import connect

from gsstream.packet import PacketKind, StreamReader
from gsstream.packet.base import build_packet
from gsstream.packet.writer import StreamWriter

_SERVE = """
import sys
from contextlib import nullcontext
from pathlib import Path
from gsstream.cli.open import relaying
from gsstream.serve.relay import is_upstream
from gsstream.serve.server import Server
with relaying(sys.argv[1]) if is_upstream(sys.argv[1]) else nullcontext(Path(sys.argv[1])) as stream:
    server = Server(stream, live=True, port=0, max_viewers=int(sys.argv[2]))
    print(server.url, flush=True)
    server.run()
"""


class Writer(threading.Thread):
    """Appends packets of one size at a rate; knows when each was in the file."""

    def __init__(self, stream: Path, key: bytes, fps: float, size: int) -> None:
        super().__init__(daemon=True)
        self.stopped, self.written = threading.Event(), dict[int, float]()
        self._writer, self._fps = StreamWriter.open(stream), fps
        self._data = np.random.default_rng(0).bytes(size)
        self._writer.append(_packet(PacketKind.KEY, 0, key))

    def run(self) -> None:
        """Write until somebody sets ``stopped``."""
        frame = 0
        while not self.stopped.wait(1 / self._fps):
            frame += 1
            # A key packet every second, so that whoever joins is not sent the whole past.
            kind = PacketKind.KEY if frame % round(self._fps) == 0 else PacketKind.DELTA
            self._writer.append(_packet(kind, frame, self._data))
            self.written[frame] = time.monotonic()


def _packet(kind: PacketKind, frame: int, data: bytes):  # type: ignore[no-untyped-def]
    return build_packet(kind, frame, [("rest", data)])


async def _watch(url: str, delays: list[float], writer: Writer, ready: asyncio.Semaphore, until: float) -> None:
    """One viewer: notes the delay of every packet that was written while it watched."""
    async with ready:
        socket = await connect(f"ws{url[4:]}live", compression=None, max_size=None, open_timeout=60)
    async with socket:
        while (left := until - time.monotonic()) > 0:
            try:
                message = await asyncio.wait_for(socket.recv(), left)
            except TimeoutError:
                return
            if isinstance(message, bytes) and len(message) > 16:
                written = writer.written.get(int.from_bytes(message[4:8], "little"))
                if written is not None:
                    delays.append(time.monotonic() - written)


def _memory(pid: int) -> int:
    """Resident bytes of a process."""
    text = Path(f"/proc/{pid}/statm").read_text(encoding="ascii")
    return int(text.split()[1]) * os.sysconf("SC_PAGE_SIZE")


def measure(url: str, pid: int, writer: Writer, viewers: int, seconds: float) -> dict[str, float]:
    """Let so many viewers watch for a while; what they saw and what the server held."""

    async def all_of_them() -> tuple[list[float], int]:
        delays: list[float] = []
        ready, until = asyncio.Semaphore(20), time.monotonic() + 5 + viewers / 50 + seconds
        tasks = [asyncio.create_task(_watch(url, delays, writer, ready, until)) for _ in range(viewers)]
        await asyncio.sleep(until - seconds - time.monotonic())
        delays.clear()  # of those that came while others were still connecting
        await asyncio.sleep(seconds * 0.8)
        held = _memory(pid)
        await asyncio.gather(*tasks)
        return delays, held

    before = _memory(pid)
    delays, held = asyncio.run(all_of_them())
    expected = viewers * len([None for at in writer.written.values() if at > time.monotonic() - seconds])
    return {
        "viewers": viewers,
        "median_ms": 1000 * median(delays),
        "p95_ms": 1000 * quantiles(delays, n=20)[-1],
        "got": len(delays) / max(1, expected),
        "kb_per_viewer": (held - before) / 1000 / viewers,
    }


@contextmanager
def _served(source: str, viewers: int) -> Iterator[tuple[str, int]]:
    """A server of a file or, for the socket of another server, a relay, in a process: its address, and its number."""
    command = [sys.executable, "-c", _SERVE, source, str(viewers)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            yield server.stdout.readline().strip(), server.pid
        finally:
            server.terminate()


def main(argv: Sequence[str] | None = None) -> int:
    """Measure every number of viewers and print a table of Markdown."""
    parser = argparse.ArgumentParser(prog="python -m tools.viewers", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--viewers", type=int, nargs="+", default=[1, 50, 200, 500])
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--relays", type=int, default=0, help="between the server that has the file and the viewers")
    parser.add_argument("--fps", type=float, default=10.0)
    parser.add_argument("--packet", type=int, default=3000, metavar="BYTES")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args(argv)
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(4096, most), most))
    found = []
    with tempfile.TemporaryDirectory() as name:
        stream = Path(name) / "stream.gss"
        writer = Writer(stream, b"key", given.fps, given.packet)
        with StreamReader(stream) as reader:
            reader.check()
        with ExitStack() as stack:
            source = str(stream)
            for _ in range(1 + given.relays):
                url, process = stack.enter_context(_served(source, max(given.viewers) + 8))
                source = f"ws{url[4:]}live"
            stack.callback(writer.stopped.set)
            writer.start()
            for viewers in given.viewers:
                found.append(measure(url, process, writer, viewers, given.seconds))
                print(json.dumps({key: round(value, 2) for key, value in found[-1].items()}), flush=True)
    print("| viewers | median delay, ms | 95 %, ms | KB a viewer |\n|--:|--:|--:|--:|")
    for row in found:
        numbers = f"{row['median_ms']:.1f} | {row['p95_ms']:.1f} | {row['kb_per_viewer']:.0f}"
        print(f"| {row['viewers']:.0f} | {numbers} |")
    if given.out is not None:
        given.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
