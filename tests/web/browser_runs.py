"""Web servers with known faults, and steps in a headless Chromium: what the tests of the page share."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from node_runs import HERE, NODE

CHROMIUM = os.environ.get("GSSTREAM_CHROMIUM") or next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
needs_browser = pytest.mark.skipif(
    NODE is None or CHROMIUM is None, reason="node or a Chromium is not installed (apt install nodejs chromium)"
)


#: The player of a page, what it shows in its own tree, what it says; a step that waits for its first picture.
PLAYER = "document.querySelector('gsstream-player')?.player"
ROOT = "document.querySelector('gsstream-player')?.shadowRoot"
MESSAGE = f"({ROOT}?.querySelector('.message')?.textContent ?? '')"
#: A step that takes workers away from the pages that are opened next: the stream is decoded on the page's thread.
WITHOUT_WORKERS = ["send", "Page.addScriptToEvaluateOnNewDocument", {"source": "delete globalThis.Worker"}]
READY = ["until", f"{PLAYER}?.state && {PLAYER}._target === null"]


class Handler(SimpleHTTPRequestHandler):
    """A static server.

    ``faults``: ranges (false: always 200), cut_after (bytes), status, gone_after (files), held_after (bytes; the others
    come once the page has asked for /mended, which ends all faults), cors (pages of other origins may read), lost (the
    connection ends at the first requests for a file: its name and how many; a page that asks for /lost/NAME/COUNT sets
    it), silent (the first request for a file of this name is never answered).
    """

    extensions_map = SimpleHTTPRequestHandler.extensions_map | {".js": "text/javascript"}

    def log_message(self, *_: object) -> None:
        """Say nothing."""

    def end_headers(self) -> None:
        if self.server.faults.get("cors"):  # type: ignore[attr-defined]
            self.send_header("Access-Control-Allow-Origin", "*")
        if "lost" in self.server.faults:  # type: ignore[attr-defined]
            self.send_header("Cache-Control", "no-store")
        super().end_headers()

    def do_GET(self) -> None:
        faults = self.server.faults  # type: ignore[attr-defined]
        self.server.requests.append((self.path, self.headers.get("Range")))  # type: ignore[attr-defined]
        if self.path == "/mended":
            faults.clear()
        if self.path.startswith("/lost/"):
            _, _, name, count = self.path.split("/")
            faults["lost"] = [name, int(count)]
        if self.path.rpartition("/")[2] == faults.get("silent"):
            del faults["silent"]
            self.server.ended.wait()  # type: ignore[attr-defined]
            return
        if self._is_lost(faults.get("lost")):
            self.close_connection = True
            return
        if not self.path.split("?")[0].endswith(".gss"):
            super().do_GET()
            return
        faults["served"] = faults.get("served", 0) + 1
        if faults["served"] > faults.get("gone_after", 1 << 30):
            self.connection.close()
            return
        data = Path(self.translate_path(self.path))
        if not data.is_file() or faults.get("status"):
            self.send_error(faults.get("status", 404))
            return
        self._send(data.read_bytes(), self.headers.get("Range"), faults)

    def _is_lost(self, lost: list[Any] | None) -> bool:
        if lost is None or lost[0] != self.path.rpartition("/")[2] or lost[1] == 0:
            return False
        lost[1] -= 1
        return True

    def _send(self, data: bytes, wanted: str | None, faults: dict[str, Any]) -> None:
        start, end, status = 0, len(data) - 1, 200
        if wanted and faults.get("ranges", True):
            first, last = wanted.removeprefix("bytes=").split("-")
            start = int(first) if first else max(0, len(data) - int(last))
            end = min(int(last), end) if first and last else end
            status = 206
            if start > end:
                self.send_response(416)
                self.send_header("Content-Range", f"bytes */{len(data)}")
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
        part = data[start : end + 1]
        self.send_response(status)
        if status == 206:
            self.send_header("Content-Range", f"bytes {start}-{end}/{len(data)}")
        self.send_header("Content-Length", str(len(part)))
        self.end_headers()
        if "held_after" in faults:
            self._send_in_two(part, faults)
            return
        cut = faults.get("cut_after")
        with contextlib.suppress(OSError):
            self.wfile.write(part if cut is None else part[:cut])
            if cut is not None and len(part) > cut:
                # What was sent is read before the connection ends: a browser drops what it has not handed on by then.
                self.wfile.flush()
                time.sleep(0.3)
                self.connection.shutdown(socket.SHUT_WR)
                self.close_connection = True

    def _send_in_two(self, part: bytes, faults: dict[str, Any]) -> None:
        held = faults["held_after"]
        with contextlib.suppress(OSError):
            self.wfile.write(part[:held])
            self.wfile.flush()
            end = time.monotonic() + 60
            while "held_after" in faults and time.monotonic() < end:
                time.sleep(0.02)
            self.wfile.write(part[held:])


class Site(ThreadingHTTPServer):
    #: A page and its workers ask for all of their modules at once, each by a connection of its own.
    request_queue_size = 64


@contextlib.contextmanager
def serving(folder: Path, **faults: Any) -> Iterator[tuple[str, ThreadingHTTPServer]]:
    """Serve a folder on loopback; yields its address and the server (``requests``, ``faults``)."""
    server = Site(("127.0.0.1", 0), partial(Handler, directory=str(folder)))
    server.faults, server.requests, server.ended = faults, [], threading.Event()  # type: ignore[attr-defined]
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}", server
    finally:
        server.ended.set()  # type: ignore[attr-defined]
        server.shutdown()
        server.server_close()
        thread.join()


def in_browser(
    steps: Sequence[Sequence[Any]], folder: Path, *, flags: Sequence[str] = (), size=(640, 400)
) -> list[Any]:
    """Carry out steps (see scenario.mjs) and return what each gave; the page must not report an error."""
    results, messages = try_in_browser(steps, folder, flags=flags, size=size)
    assert messages == []
    return results


def try_in_browser(
    steps: Sequence[Sequence[Any]], folder: Path, *, flags: Sequence[str] = (), size=(640, 400)
) -> tuple[list[Any], list[str]]:
    """Like :func:`in_browser`; also returns the errors that the page reported."""
    plan, out = folder / "steps.json", folder / "steps-results.json"
    plan.write_text(json.dumps({"width": size[0], "height": size[1], "flags": list(flags), "steps": list(steps)}))
    command = [str(NODE), str(HERE / "scenario.mjs"), str(CHROMIUM), str(plan), str(out)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(out.read_text())
    assert found["failure"] is None, found
    return found["results"], found["messages"]


def at(url: str, steps: Sequence[Sequence[Any]]) -> list[list[Any]]:
    """The steps with the address of a server in the place of URL."""
    return [[item.replace("URL", url) if isinstance(item, str) else item for item in step] for step in steps]
