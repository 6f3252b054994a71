"""A web server whose files say how long they may be kept, and a cache before it, as small as RFC 9111 allows."""

from __future__ import annotations

import fnmatch
import hashlib
import re
import threading
import time
import urllib.error
import urllib.request
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

from stores import serving

PAGE = Path(__file__).parents[2] / "docs" / "howto" / "many.md"
#: What the cache hands on besides the file.
PASSED = ("Cache-Control", "ETag", "Access-Control-Allow-Origin", "Access-Control-Expose-Headers", "Content-Type")


def rules() -> dict[str, str]:
    """Pattern of a name -> Cache-Control, as the how-to says; of manifests what it says of a live page."""
    table = PAGE.read_text(encoding="utf-8").split("| files | Cache-Control |")[1].split("\n\n")[0]
    found: dict[str, str] = {}
    for files, header in re.findall(r"^\| (.+?) \| `(.+?)` \|$", table, re.M):
        found |= dict.fromkeys(re.findall(r"`(.+?)`", files) or ["*"], header)
    return found


class _Quiet(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def log_message(self, *_: Any) -> None:
        pass

    def answer(self, status: int, data: bytes, headers: Mapping[str, str]) -> None:
        self.send_response(status)
        for name, value in {**headers, "Content-Length": str(len(data))}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(data)


@contextmanager
def origin(folder: Path) -> Iterator[tuple[str, Counter[str]]]:
    """Serve a folder with the headers of the how-to; gives its address, and how often each file was sent."""
    sent: Counter[str] = Counter()
    said = rules()

    class Origin(_Quiet):
        def do_GET(self) -> None:
            name = self.path.lstrip("/")
            try:
                data = (folder / name).read_bytes()
            except OSError:
                self.answer(404, b"", {})
                return
            kept = next(header for pattern, header in said.items() if fnmatch.fnmatch(name, pattern))
            headers = {
                "Cache-Control": kept,
                "ETag": f'"{hashlib.sha256(data).hexdigest()[:16]}"',
                "Access-Control-Allow-Origin": "*",
                "Access-Control-Expose-Headers": "Content-Range, ETag",
            }
            if self.headers.get("If-None-Match") == headers["ETag"]:
                sent[f"{name} again"] += 1
                self.answer(304, b"", headers)
                return
            sent[name] += 1
            self.answer(200, data, headers)

    with serving(Origin) as address:
        yield address, sent


@contextmanager
def proxy(upstream: str) -> Iterator[str]:
    """A cache that asks ``upstream`` once for what many ask of it at the same time."""
    kept: dict[str, tuple[float, bytes, dict[str, str]]] = {}
    locks: dict[str, threading.Lock] = {}
    one = threading.Lock()

    class Proxy(_Quiet):
        def do_GET(self) -> None:
            with one:
                lock = locks.setdefault(self.path, threading.Lock())
            with lock:
                if self.path not in kept or kept[self.path][0] < time.monotonic():
                    status = self.ask()
                    if status != 200:
                        self.answer(status, b"", {})
                        return
                _, data, headers = kept[self.path]
            if self.headers.get("If-None-Match") == headers.get("ETag"):
                self.answer(304, b"", headers)
                return
            wanted = re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range", ""))
            if wanted is None:
                self.answer(200, data, headers)
                return
            begin, end = int(wanted[1]), min(int(wanted[2] or len(data)), len(data) - 1)
            part = {"Content-Range": f"bytes {begin}-{end}/{len(data)}"}
            self.answer(206, data[begin : end + 1], headers | part)

        def ask(self) -> int:
            request = urllib.request.Request(upstream + self.path)
            if self.path in kept:
                request.add_header("If-None-Match", kept[self.path][2]["ETag"])
            try:
                with urllib.request.urlopen(request, timeout=60) as answer:
                    data, headers = answer.read(), answer.headers
            except urllib.error.HTTPError as error:
                if error.code != 304:
                    return error.code
                data, headers = kept[self.path][1], error.headers
            age = re.search(r"max-age=(\d+)", headers.get("Cache-Control", ""))
            until = time.monotonic() + (int(age[1]) if age else 0)
            kept[self.path] = until, data, {name: headers[name] for name in PASSED if name in headers}
            return 200

    with serving(Proxy) as address:
        yield address
