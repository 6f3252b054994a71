"""The page of a package in a browser: time to the first picture, and what the page's own thread does.

    python -m tools.page [--streams RUN ...] [--synthetic NUMBERxFRAMES ...] [--before COMMIT] --out FILE.jsonl

Each stream, and each synthetic one (a scene of random Gaussians with harmonics of degree 3, of which a twentieth
changes in every frame; a key packet in the middle), becomes a package with the page of this checkout and one with the
page of another commit. They are opened in turn, each time in a browser without a cache, round after round: what else
the machine does then concerns both. One link of 20 Mbit/s and 20 milliseconds lies between the browser and this
server, for all requests together, and text is packed as web servers pack it.

A row of the output is a stream and a page, named by git's hash of ``gsstream/web``: seconds to its first picture, and
to the first whole one, in each round, and the processor time that the browser took for that, which other work on the
machine changes little; of the page's thread, while it plays and seeks, the longest task, by its processor time, and the
tasks above 16 ms, in the worst round; the processor time of it for each picture.
"""

from __future__ import annotations

import argparse
import gzip
import io
import json
import shutil
import subprocess
import tarfile
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.changes import Delta, Layout, Residual
from gsstream.core.gaussians import Gaussians
from gsstream.packet import KeyState, StreamMeta, StreamWriter, encode_delta, encode_key
from gsstream.player.playback import Playback
from gsstream.serve.package import package

ROOT = Path(__file__).parents[1]
WORK = ROOT / "tests" / "web" / "page_work.mjs"
BYTES_A_SECOND, ROUND_TRIP = 20e6 / 8, 0.02
#: Gaussians of a node in a synthetic stream, and the share of nodes that changes.
IN_NODE, SHARE = 10, 0.05


class Link:
    """Bytes of all connections go one after the other, at one rate."""

    def __init__(self) -> None:
        self._lock, self._free = threading.Lock(), 0.0

    def send(self, size: int) -> None:
        """Wait as long as ``size`` bytes take from when the link is free."""
        with self._lock:
            self._free = max(self._free, time.monotonic()) + size / BYTES_A_SECOND
            end = self._free
        time.sleep(max(0.0, end - time.monotonic()))


class Handler(SimpleHTTPRequestHandler):
    """Static files through the link of the server."""

    protocol_version = "HTTP/1.1"
    extensions_map = SimpleHTTPRequestHandler.extensions_map | {".js": "text/javascript"}

    def log_message(self, *_: object) -> None:
        """Say nothing."""

    def do_GET(self) -> None:
        """Answer after a round trip, a piece of a network's packets at a time."""
        time.sleep(ROUND_TRIP)
        path = Path(self.translate_path(self.path))
        if not path.is_file():
            self.send_error(404)
            return
        data, text = path.read_bytes(), path.suffix in (".js", ".html", ".json")
        if text:
            data = gzip.compress(data)
        self.send_response(200)
        self.send_header("Content-Type", self.guess_type(str(path)))
        self.send_header("Content-Length", str(len(data)))
        if text:
            self.send_header("Content-Encoding", "gzip")
        self.end_headers()
        for at in range(0, len(data), 14_600):
            self.server.link.send(len(data[at : at + 14_600]))  # type: ignore[attr-defined]
            self.wfile.write(data[at : at + 14_600])


@contextmanager
def serving(folder: Path) -> Iterator[str]:
    """Serve a folder on loopback behind a link of its own; yields its address."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(folder)))
    server.link = Link()  # type: ignore[attr-defined]
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()


def write_synthetic(path: Path, number: int, frames: int) -> None:
    """Write a stream of ``number`` random Gaussians seen by one camera."""
    rng, nodes = np.random.default_rng(0), number // IN_NODE
    centers = np.repeat(rng.normal(size=(nodes, 3)), IN_NODE, 0)
    scene = Gaussians(
        means=(centers + 0.02 * rng.normal(size=(number, 3))).astype(np.float32),
        quats=rng.normal(size=(number, 4)).astype(np.float32),
        scales=(0.5 * rng.normal(size=(number, 3)) - 4.5).astype(np.float32),
        opacities=(2 * rng.normal(size=number)).astype(np.float32),
        sh0=rng.normal(size=(number, 1, 3)).astype(np.float32),
        shN=(0.05 * rng.normal(size=(number, 15, 3))).astype(np.float32),
    )
    layout = Layout(np.full(nodes, IN_NODE, np.int32), np.zeros(number, np.uint8), np.ones(1, np.float32))
    viewmat = np.eye(4)
    viewmat[2, 3] = 4
    rig = Cameras(("front",), viewmat[None], np.array([[[300.0, 0, 160], [0, 300, 90], [0, 0, 1]]]), 320, 180)
    meta = StreamMeta("dense", "synthetic", {}, rig, rig.select([]), 30.0, (0.0, 0.0, 0.0))
    with StreamWriter.open(path) as writer:
        for frame in range(frames):
            if frame in (0, frames // 2):
                writer.append(encode_key(KeyState(scene, layout, meta), frame=frame))
                continue
            gates = (rng.random(nodes) < SHARE).astype(np.uint8)
            rows = IN_NODE * int(gates.sum())
            symbols = {name: np.rint(rng.laplace(size=(rows, 3))).astype(np.int32) for name in ("means", "sh0")}
            delta = Delta((Residual(gates, 1, symbols, {"means": 0.003, "sh0": 0.05}),))
            writer.append(encode_delta(delta, layout, {}, frame=frame))


def with_page_of(site: Path, commit: str, out: Path) -> Path:
    """Return a copy of a package with the page of another commit."""
    archive = subprocess.run(
        ["git", "archive", commit, "gsstream/web"], cwd=ROOT, capture_output=True, check=True
    ).stdout
    shutil.copytree(site, out)
    with tarfile.open(fileobj=io.BytesIO(archive)) as files, tempfile.TemporaryDirectory() as folder:
        files.extractall(folder, filter="data")
        shutil.copytree(Path(folder) / "gsstream" / "web", out, dirs_exist_ok=True)
    return out


def name_of(commit: str) -> str:
    """Return what names the page of a commit: git's hash of its folder, which is the same on every branch."""
    command = ["git", "rev-parse", "--short=7", f"{commit}:gsstream/web"]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def measure(site: Path, chromium: str, seconds: float) -> dict[str, Any]:
    """Open a package once in a browser of its own."""
    with serving(site) as url:
        command = ["node", str(WORK), chromium, f"{url}/index.html", str(seconds)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=900, check=True)
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def row_of(facts: dict[str, Any], page: str, runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return a row of the output from the runs of one stream and page."""

    def each(name: str) -> str:
        return ", ".join(f"{run[name] / 1000:.2f}" for run in runs)

    return {
        **facts,
        "page": page,
        "first_picture_s": each("first"),
        "whole_picture_s": each("whole"),
        "processor_s": ", ".join(f"{run['processor']:.2f}" for run in runs),
        "decoded": runs[0]["decoded"],
        "longest_task_ms": max(run["longest"]["cpu"] for run in runs),
        "tasks_above_16_ms": max(run["long"] for run in runs),
        "thread_ms_each_picture": round(sorted(run["perPicture"] for run in runs)[len(runs) // 2], 1),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure as the arguments say and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--streams", nargs="*", type=Path, default=[], help="run folders or streams")
    parser.add_argument("--synthetic", nargs="*", default=[], metavar="NUMBERxFRAMES")
    parser.add_argument("--before", metavar="COMMIT", help="measure the page of this commit, too")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=4, help="of playing")
    parser.add_argument("--out", type=Path, required=True, help="file of rows, which is extended")
    given = parser.parse_args(arguments)
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
    with tempfile.TemporaryDirectory() as name:
        streams = [run / "stream.gss" if run.is_dir() else run for run in given.streams]
        for size in given.synthetic:
            number, frames = map(int, size.split("x"))
            streams.append(Path(name) / f"{size}.gss")
            write_synthetic(streams[-1], number, frames)
        for i, stream in enumerate(streams):
            site = Path(name) / str(i)
            package(stream, site)
            pages = {name_of("HEAD"): site}
            if given.before:
                other = with_page_of(site, given.before, Path(name) / f"{i}-before")
                pages = {name_of(given.before): other, **pages}
            with Playback(stream) as playback:
                facts = {
                    "stream": "synthetic" if stream.parent == Path(name) else playback.meta.source,
                    "frames": len(playback.frames),
                    "Gaussians": len(playback.state_at(playback.frames[0])),
                    "key_KB": round(playback.entry(playback.frames[0]).size / 1000),
                }
            runs: dict[str, list[dict[str, Any]]] = {page: [] for page in pages}
            for _ in range(given.rounds):
                for page, folder in pages.items():
                    runs[page].append(measure(folder, chromium, given.seconds))
            with given.out.open("a", encoding="utf-8") as file:
                for page, found in runs.items():
                    print(json.dumps(row_of(facts, page, found)), file=file)


if __name__ == "__main__":
    main()
