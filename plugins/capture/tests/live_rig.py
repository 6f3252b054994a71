"""Cameras for tests: encoded pictures that carry their number, RTSP servers as processes, what arrived."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
import threading
import time
from fractions import Fraction
from functools import cache
from pathlib import Path

import av
import numpy as np
from PIL import Image

HERE = Path(__file__).parent
SYSTEM_PYTHON = "/usr/bin/python3"
NEEDS = "gir1.2-gst-rtsp-server-1.0 python3-gst-1.0 gstreamer1.0-plugins-good gstreamer1.0-plugins-bad"
BITS, CELL = 9, 16


@cache
def has_server() -> bool:
    """Whether the system's Python can serve RTSP."""
    code = "import gi; gi.require_version('GstRtspServer', '1.0'); from gi.repository import Gst, GstRtspServer;"
    code += "Gst.init(None); assert all(map(Gst.ElementFactory.find, ('h264parse', 'rtph264pay', 'appsrc')))"
    try:
        return subprocess.run([SYSTEM_PYTHON, "-c", code], capture_output=True, check=False, timeout=60).returncode == 0
    except OSError:
        return False


def painted(picture: np.ndarray, number: int) -> np.ndarray:
    """The picture [H, W, 3] uint8 with its number as black and white squares along its upper edge."""
    out = picture.copy()
    for bit in range(BITS):
        out[:CELL, CELL * bit : CELL * (bit + 1)] = 255 * (number >> bit & 1)
    return out


def number_of(picture: np.ndarray) -> int:
    """The number that is painted into a picture."""
    inner = slice(CELL // 4, 3 * CELL // 4)
    cells = (picture[inner, CELL * b + CELL // 4 : CELL * b + 3 * CELL // 4] for b in range(BITS))
    return sum(1 << bit for bit, cell in enumerate(cells) if cell.mean() > 127)


def grey(number: int, size: tuple[int, int], camera: int = 0) -> np.ndarray:
    """A cheap picture: a ramp that moves with its number."""
    across = np.arange(size[0])[None, :] * 3 + np.arange(size[1])[:, None] + 5 * number + 40 * camera
    return np.repeat((across % 200 + 20).astype(np.uint8)[..., None], 3, 2)


def encoded(path: Path, pictures, fps: int, *, gop: int = 10, suffix: str = "units") -> Path:
    """Write pictures as access units of H.264 (``units``) or as a video file (``mp4``, ``avi`` of MJPEG)."""
    codec = "mjpeg" if suffix == "avi" else "libx264"
    target = path.with_suffix(f".{suffix}")
    with av.open(str(target), "w", format="h264" if suffix == "units" else None) as box:
        first = next(pictures := iter(pictures))
        stream = box.add_stream(codec, rate=fps)
        stream.height, stream.width = first.shape[:2]
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        stream.time_base = Fraction(1, fps)
        if codec == "libx264":
            stream.options = {
                "preset": "ultrafast",
                "tune": "zerolatency",
                "crf": "20",
                "x264-params": f"keyint={gop}:scenecut=0:bframes=0:repeat-headers=1",
            }
        units = []
        for picture in (first, *pictures):
            packets = stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24"))
            units += [bytes(packet) for packet in packets] if suffix == "units" else []
            if suffix != "units":
                box.mux(packets)
        packets = stream.encode(None)
        if suffix == "units":
            units += [bytes(packet) for packet in packets]
        else:
            box.mux(packets)
    if suffix == "units":
        target.write_bytes(b"".join(struct.pack("<I", len(unit)) + unit for unit in units))
    return target


class Server:
    """RTSP cameras in a process of their own."""

    def __init__(self, units: dict[str, Path], fps: float, epoch: float, *, port: int = 0, login: str = "") -> None:
        command = [SYSTEM_PYTHON, str(HERE / "rtsp_server.py"), str(port), str(fps), str(epoch)]
        command += [f"{name}={path}" for name, path in units.items()]
        if login:
            user, _, password = login.partition(":")
            command += ["--user", user, "--password", password]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        assert self.process.stdout is not None
        self.port = int(self.process.stdout.readline().split()[1])

    def url(self, name: str) -> str:
        return f"rtsp://127.0.0.1:{self.port}/{name}"

    def say(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def send(self, signal: int) -> None:
        self.process.send_signal(signal)

    def stop(self) -> None:
        self.process.kill()
        self.process.wait()

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


def calibration(folder: Path, ids: list[str], size: tuple[int, int], **more: object) -> Path:
    """A cameras.json of cameras on a circle that look at its middle."""
    cameras = []
    for i, name in enumerate(ids):
        turn = 0.4 * i
        c, s = np.cos(turn), np.sin(turn)
        rotation = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        w2c = np.eye(4)
        w2c[:3, :3], w2c[:3, 3] = rotation, (0, 0, 3)
        K = [[size[0], 0, size[0] / 2], [0, size[0], size[1] / 2], [0, 0, 1]]
        one = {
            "id": name,
            "width": size[0],
            "height": size[1],
            "K": K,
            "w2c": w2c.tolist(),
            "frames": f"{name}/%06d.jpg",
        }
        cameras.append(one | dict(more))
    path = folder / "cameras.json"
    path.write_text(json.dumps({"schema": "opencv-multiview-1", "fps": 10, "cameras": cameras}))
    return path


def rig_file(folder: Path, cameras: dict[str, str], fps: float = 10, *, more: str = "", each: str = "") -> Path:
    rows = "".join(f'  - {{id: {name}, url: "{url}"{each}}}\n' for name, url in cameras.items())
    path = folder / "rig.yaml"
    path.write_text(f"fps: {fps}\ncalibration: cameras.json\n{more}cameras:\n{rows}")
    return path


def captured(folder: Path) -> list[dict[str, int]]:
    """For each instant: camera -> the number painted into its picture."""
    out: dict[int, dict[str, int]] = {}
    for path in sorted(folder.glob("*/*.jpg")):
        with Image.open(path) as image:
            out.setdefault(int(path.stem), {})[path.parent.name] = number_of(np.asarray(image.convert("RGB")))
    return [out[index] for index in sorted(out)]


class Capturing:
    """``gsstream capture`` as a process; its lines as they come."""

    def __init__(self, rig: Path, out: Path, *options: str, environment: dict[str, str] | None = None) -> None:
        code = "from gsstream.cli.main import main; main()"
        command = [sys.executable, "-c", code, "capture", str(rig), "--out", str(out), *options]
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment
        )
        self.lines: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append(line.rstrip())

    def wait_for(self, text: str, seconds: float = 40) -> str:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            for line in list(self.lines):
                if text in line:
                    return line
            if self.process.poll() is not None and not self._reader.is_alive():
                break
            time.sleep(0.05)
        raise AssertionError(f"no line with {text!r} in {self.lines}")

    def end(self, seconds: float = 60) -> int:
        code = self.process.wait(seconds)
        self._reader.join(5)
        return code
