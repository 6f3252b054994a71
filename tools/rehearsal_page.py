"""The whole way of a rehearsal: ``capture --check``, a command that captures and encodes, and a browser that shows it.

Called by ``python -m tools.rehearsal --browser``; needs node and a Chromium, which the tests of the page drive.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from PIL import Image

from gsstream.core.errors import GsstreamError
from gsstream.engine.run.session import METRICS
from gsstream.evaluation.records import read_lines
from tools.drill import GSSTREAM

ROOT = Path(__file__).parents[1]
#: Frames that the page shows before its picture is taken, and seconds that they may take.
FRAMES, PATIENCE = 60, 600.0
#: Keep when the pixels of a frame could be read back from the graphics: until then nobody sees it.
FINISH = """(() => {
  const player = PLAYER;
  player.finished = [];
  const shown = player.shown.bind(player);
  player.shown = () => {
    shown();
    const { gl } = player.renderer;
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    player.finished.push([player.frame, Date.now()]);
  };
})()"""


def checked(rig: Path, out: Path) -> dict[str, Any]:
    """Run ``gsstream capture --check``; return its exit code and its lines."""
    command = [*GSSTREAM, "capture", str(rig), "--check", "--out", str(out / "check")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    pictures = sorted(path.stem for path in (out / "check").glob("*.jpg"))
    return {"code": done.returncode, "said": (done.stdout + done.stderr).splitlines(), "pictures_of": pictures}


def shown(rig: Path, out: Path, size: tuple[int, int], test: str) -> dict[str, Any]:
    """Capture and encode in one command, and look at the stream in a browser while it grows.

    Arguments:
        size: (width, height) of the cameras' pictures, and of the browser's window.
        test: the camera from whose place the page shows the scene first.

    Returns the frame that the page showed, how far its picture is from the camera's of that instant, and how late
    frames were: from their exposure to files, packets, and pixels in the page. Raises GsstreamError when the run ends
    before that.
    """
    sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "tests" / "packet"), str(ROOT / "tests" / "web")]
    from browser_runs import MESSAGE, PLAYER
    from live_runs import browsing

    port = _free_port()
    command = [*GSSTREAM, "run", "--source", f"rig:{rig}?folder={out / 'capture'}", "--method", "s2gs-edge"]
    command += ["--recipe", "recording:live", "--serve", str(port), "--out", str(out / "run"), "--no-pictures"]
    with (
        (out / "run.log").open("w") as log,
        subprocess.Popen(command, stdout=log, stderr=log) as process,
        browsing(*size) as page,
    ):
        try:
            _wait_for(out / "run" / METRICS, process)
            page.go(f"http://127.0.0.1:{port}")
            page.until(f"{PLAYER}?.latency", PATIENCE)
            page.evaluate(FINISH.replace("PLAYER", PLAYER))
            page.until(f"{PLAYER}?.latency?.frames.length >= {FRAMES}", PATIENCE)
            page.evaluate(f"{PLAYER}.pause()")
            time.sleep(1.0)
            frame = page.evaluate(f"{PLAYER}.frame")
            page.screenshot(str(out / "browser.png"))
            late, finished, said = page.evaluate(f"[{PLAYER}.latency.frames, {PLAYER}.finished, {MESSAGE}]")
        finally:
            process.terminate()
            process.wait()
    seen = out / "capture" / test / f"{frame:06d}.jpg"
    return {
        "page_said": [said, *page.messages],
        "frame": frame,
        "page_against_camera_db": round(_psnr(out / "browser.png", seen), 2),
        **_latencies(out, late, finished),
        "load": round(os.getloadavg()[0], 1),
    }


def _latencies(out: Path, late: Sequence[dict[str, float]], finished: Sequence[Sequence[float]]) -> dict[str, Any]:
    """Medians over the encoded frames that the page drew, milliseconds; all clocks are this machine's."""
    captured = read_lines(out / "capture" / "capture.jsonl")
    exposed = {line["frame"]: 1000 * line["time"] for line in captured}
    written = {line["frame"]: line["written_ms"] for line in captured}
    lines = [line for line in read_lines(out / "run" / METRICS)[1:] if line["live"]["policy"] is None]
    steps = {line["frame"]: 1000 * sum(line["seconds"].values()) for line in lines}
    there: dict[int, float] = {}
    for frame, when in finished:
        there.setdefault(int(frame), when)
    rows = [(int(entry["frame"]), entry) for entry in late if entry["frame"] in there and entry["frame"] in steps]
    times = {
        "exposure_to_file_ms": [written[frame] for frame, _ in rows],
        "frame_step_ms": [steps[frame] for frame, _ in rows],
        "exposure_to_packet_ms": [entry["written"] - exposed[frame] for frame, entry in rows],
        "packet_to_page_ms": [entry["came"] for _, entry in rows],
        "packet_to_drawn_ms": [entry["drawn"] for _, entry in rows],
        "exposure_to_pixels_ms": [there[frame] - exposed[frame] for frame, _ in rows],
    }
    if not rows:
        return {"frames_measured": 0}
    return {"frames_measured": len(rows), **{name: round(median(values)) for name, values in times.items()}}


def _wait_for(path: Path, process: subprocess.Popen[Any]) -> None:
    end = time.monotonic() + PATIENCE
    while not (path.exists() and path.stat().st_size):
        if process.poll() is not None or time.monotonic() > end:
            raise GsstreamError(f"no first frame; the run ended with {process.poll()}")
        time.sleep(0.2)


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def _psnr(one: Path, two: Path) -> float:
    with Image.open(one) as first, Image.open(two) as second:
        a, b = (np.asarray(image.convert("RGB"), np.float64) for image in (first, second))
    return float(10 * np.log10(255**2 / max(float(np.mean((a - b) ** 2)), 1e-9)))
