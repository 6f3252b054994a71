"""How a capture ends that nobody ended: a full disk, and cameras that are all silent."""

from __future__ import annotations

import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import SimpleNamespace

import pytest
from gsstream_capture import capture, folder
from gsstream_capture.pictures import jpeg
from gsstream_capture.report import summary
from gsstream_capture.rig import read_rig
from live_rig import calibration, captured, encoded, grey, painted, rig_file

SIZE = (160, 120)


def numbered(count):
    return (painted(grey(i, SIZE), i) for i in range(count))


@pytest.mark.parametrize(("free", "frames"), [(500_000_000, 10), (50_000_000, 10), (5_000_000_000, 60)])
def test_a_disk_that_fills_up(tmp_path, monkeypatch: pytest.MonkeyPatch, free, frames) -> None:
    """Whole instants are dropped and counted; where nothing is left the capture ends, and is a whole recording."""
    calibration(tmp_path, ["a"], SIZE)
    encoded(tmp_path / "a", numbered(60), 15, suffix="mp4")
    rig = read_rig(rig_file(tmp_path, {"a": "a.mp4"}, 15))
    # The system says that there is room, until ten instants are there.
    left = iter([5_000_000_000])
    monkeypatch.setattr(folder.shutil, "disk_usage", lambda _: SimpleNamespace(free=next(left, free)))
    out = tmp_path / "out"
    report = capture.run_capture(rig, tmp_path, out, seconds=None, say=lambda _: None, stopped=threading.Event())
    assert abs(report.frames - frames) <= 2
    assert len(captured(out)) == report.frames
    assert (out / "END").exists()
    assert (report.ended == "the disk is full") == (free < folder.FULL)
    assert (report.disk > 0) == (free < folder.LOW)
    assert ("less than 1 GB" in summary(report)) == (free < folder.LOW)


def test_all_cameras_are_silent(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A camera of HTTP that sends for three seconds, and then keeps its connection open and says nothing."""
    pictures = [jpeg(picture, 90) for picture in numbered(30)]

    class Stalls(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
            self.end_headers()
            for data in pictures:
                self.wfile.write(
                    b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n%s\r\n" % (len(data), data)
                )
                time.sleep(0.1)
            time.sleep(30)

        def log_message(self, *_) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Stalls)
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    calibration(tmp_path, ["a"], SIZE)
    monkeypatch.setattr(capture, "TIMEOUT", 1.0)
    rig = read_rig(rig_file(tmp_path, {"a": f"http://127.0.0.1:{server.server_address[1]}/"}, 10))
    out, none = tmp_path / "out", threading.Event()
    report = capture.run_capture(rig, tmp_path, out, seconds=60, say=lambda _: None, stopped=none)
    server.shutdown()
    assert report.ended == "no camera has sent a picture for 1 s"
    assert (out / "END").exists()
    assert report.frames > 15
