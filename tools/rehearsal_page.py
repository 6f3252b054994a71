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
FRAMES, PATIENCE = 20, 600.0


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
    frames were: from their files to packets, and until the page had drawn them. Raises GsstreamError when the run
    ends before that.
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
            page.until(f"{PLAYER}?.latency?.frames.length >= {FRAMES}", PATIENCE)
            page.evaluate(f"{PLAYER}.pause()")
            time.sleep(1.0)
            frame = page.evaluate(f"{PLAYER}.frame")
            page.screenshot(str(out / "browser.png"))
            late, said = page.evaluate(f"[{PLAYER}.latency.frames, {MESSAGE}]")
        finally:
            process.terminate()
            process.wait()
    seen = out / "capture" / test / f"{frame:06d}.jpg"
    return {
        "page_said": [said, *page.messages],
        "frame": frame,
        "page_against_camera_db": round(_psnr(out / "browser.png", seen), 2),
        **_latencies(out, late),
        "load": os.getloadavg()[0],
    }


def _latencies(out: Path, late: Sequence[dict[str, float]]) -> dict[str, Any]:
    lines = [line for line in read_lines(out / "run" / METRICS)[1:] if line["live"]["policy"] is None]
    return {
        "frames_measured": len(late),
        "file_to_packet_ms": round(1000 * median(line["live"]["latency_seconds"] for line in lines)),
        "packet_to_drawn_ms": round(median(entry["drawn"] for entry in late)),
    }


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
