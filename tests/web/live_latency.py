# ruff: noqa: E402
"""Measure how late the picture of a live stream is, end to end on loopback, with real processes.

Usage: python tests/web/live_latency.py --frames 40 --fps 1 [--method s2gs-edge] [--replay-fps 10]

A writer copies the frames of the demo (there and back again) into a watched folder, ``gsstream run`` encodes them,
``gsstream open --live`` sends them, a headless Chromium with software graphics shows them. Then the packets of that
stream are written into another file at ``--replay-fps``, without cameras and encoder. Times count from the file's time
of modification to the moment when the pixels of the frame could be read back from the graphics.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "tests" / "packet")]
from live_runs import Growing, browsing, served

from gsstream.packet import EncodedPacket, StreamReader
from tests.flow import capture
from tests.flow.flow_runs import demo_copy

PLAYER = "document.querySelector('gsstream-player').player"
#: Draw, and wait until the pixels are there; keep when that was, by the server's clock.
FINISH = f"""(() => {{
  const player = {PLAYER};
  player.finished = [];
  const draw = player.draw.bind(player);
  player.draw = (options) => {{
    draw(options);
    const {{ gl }} = player.renderer;
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    player.finished.push([player.frame, Date.now() + player.buffer.socket.ahead]);
  }};
}})()"""
FIELDS = ("came", "drawn", "finished")


def longer(folder: Path, frames: int) -> Path:
    """The demo, its frames there and back again until there are enough."""
    short = demo_copy(folder / "demo", train=8, frames=12)
    data = json.loads((short / "cameras.json").read_text())
    for camera in data["cameras"]:
        for t in range(12, frames):
            turn = t % 22
            source = short / (camera["frames"] % min(turn, 22 - turn))
            shutil.copy(source, short / (camera["frames"] % t))
    (short / "cameras.json").write_text(json.dumps({**data, "frames": frames}))
    return short


def times(page: Any) -> list[dict[str, float]]:
    """Milliseconds from written to received, drawn and finished, of every frame that was drawn in turn."""
    known = page.evaluate(f"{PLAYER}.buffer.latency.frames")
    finished: dict[int, float] = {}
    for frame, when in page.evaluate(f"{PLAYER}.finished"):
        finished.setdefault(frame, when)
    return [e | {"finished": finished[e["frame"]] - e["written"]} for e in known if e["frame"] in finished]


def report(what: str, measured: list[dict[str, float]]) -> None:
    """One line for each time: median, 95th percentile and worst."""
    print(f"{what}: {len(measured)} frames")
    for name in FIELDS:
        values = sorted(entry[name] for entry in measured)
        most = values[int(0.95 * (len(values) - 1))]
        middle, worst = statistics.median(values), values[-1]
        print(f"  written to {name}: median {middle:.0f} ms, 95 % {most:.0f}, worst {worst:.0f}")


def watched(page: Any, url: str, clock: float = 4.0) -> None:
    """Open the page and let it learn the server's clock before anything comes."""
    page.go(url)
    page.until(f"{PLAYER.replace(').player', ')?.player')}?.buffer?.socket?.socket?.readyState === 1", 60)
    time.sleep(clock)
    page.evaluate(FINISH)


def end_to_end(page: Any, folder: Path, frames: int, fps: float, method: str) -> Path:
    """Cameras to pixels; returns the stream."""
    finished, out = longer(folder, frames), folder / "run"
    capture.begin(finished, folder / "watched")
    run = [
        sys.executable, "-c", "from gsstream.cli.main import main; main()", "run", "--method", method,
        "--source", f"watch:{folder / 'watched'}?ready=rename", "--out", str(out), "--quiet", "--no-pictures",
        "--set", "first_frame.max_iterations=100",
    ]  # fmt: skip
    with served(out, "--live", "--port", 0) as (url, _):
        watched(page, url)
        with (
            subprocess.Popen(run) as encoder,
            subprocess.Popen(
                [sys.executable, str(Path(capture.__file__)), str(finished), str(folder / "watched"), str(fps)]
            ),
        ):
            page.until(f"{PLAYER}.frame === {frames - 1}", 500)
            page.until(f"{PLAYER}.finished.some(([frame]) => frame === {frames - 1})", 60)
            encoder.wait(timeout=120)
        report(f"end to end, {method}, a frame every {1 / fps:.1f} s", times(page))
    return out / "stream.gss"


def replayed(page: Any, folder: Path, stream: Path, fps: float) -> None:
    """The packets of a stream, written at a rate."""
    with StreamReader(stream) as reader:
        packets = [EncodedPacket(reader.read(entry), {}) for entry in reader.frames]
    with served(folder / "replay.gss", "--live", "--port", 0) as (url, _):
        watched(page, url)
        Growing(folder / "replay.gss").write(packets, pause=1 / fps)
        page.until(f"{PLAYER}.finished.some(([frame]) => frame === {packets[-1].frame})", 60)
        report(f"replayed at {fps:g} frames a second", times(page))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--fps", type=float, default=1.0, help="frames that the cameras write in a second")
    parser.add_argument("--method", default="s2gs-edge")
    parser.add_argument("--stream", type=Path, help="only write the packets of this stream again")
    parser.add_argument("--replay-fps", type=float, default=10.0)
    given = parser.parse_args()
    print(f"{os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}")
    with tempfile.TemporaryDirectory() as name, browsing(320, 240) as page:
        stream = given.stream or end_to_end(page, Path(name), given.frames, given.fps, given.method)
        print(f"  {stream.stat().st_size / 1e3:.0f} KB")
        replayed(page, Path(name), stream, given.replay_fps)
        print(f"load {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    main()
