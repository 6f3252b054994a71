"""Cameras that die and come back: real processes that are stopped, continued, killed, or send rubbish.

The number that is painted into every picture says which instant was taken. What happens in one capture is looked at by
several tests, so that the minute is spent once.
"""

from __future__ import annotations

import json
import signal
import socket
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from live_rig import (
    NEEDS,
    Capturing,
    Server,
    calibration,
    captured,
    encoded,
    grey,
    has_server,
    number_of,
    painted,
    rig_file,
)
from PIL import Image

FPS, SIZE, LENGTH = 10, (320, 240), 500
LOGIN = "opener:pass%2Fword77"

#: They take place in real time, with processes that are stopped and killed: a machine that is too busy fails them.
pytestmark = [
    pytest.mark.live,
    pytest.mark.skipif(not has_server(), reason=f"no RTSP server of GStreamer here (apt install {NEEDS})"),
]


@pytest.fixture(scope="module")
def units(tmp_path_factory):
    folder = tmp_path_factory.mktemp("units")
    made = {
        n: encoded(folder / n, (painted(grey(i, SIZE, k), i) for i in range(LENGTH)), FPS) for k, n in enumerate("ab")
    }
    small = encoded(folder / "small", (painted(grey(i, (160, 128)), i) for i in range(50)), FPS)
    return made | {"small": small}


@pytest.fixture(scope="module")
def story(units, tmp_path_factory):
    """One capture of five cameras in five processes; each has its own fate."""
    folder, names = tmp_path_factory.mktemp("story"), ["sound", "stopped", "killed", "garbage", "resized"]
    epoch = time.time()
    one = {n: Server({n: units["ab"[k % 2]]}, FPS, epoch) for k, n in enumerate(names)}
    calibration(folder, names, SIZE)
    rig = rig_file(folder, {name: server.url(name) for name, server in one.items()}, FPS)
    capture = Capturing(rig, folder / "out")
    try:
        capture.wait_for("paired by")
        began = time.time()
        one["stopped"].send(signal.SIGSTOP)
        one["killed"].stop()
        one["garbage"].say("garbage garbage 7")
        one["resized"].say(f"units resized {units['small']}")
        time.sleep(4.5)
        one["stopped"].send(signal.SIGCONT)
        again = Server({"killed": units["a"]}, FPS, epoch, port=one["killed"].port)
        one["killed"] = again
        one["resized"].say(f"units resized {units['a']}")
        deadline = time.monotonic() + 25
        while time.monotonic() < deadline and sum(" is back; " in line for line in capture.lines) < 3:
            time.sleep(0.2)
        time.sleep(1.5)
        capture.process.send_signal(signal.SIGINT)
        code = capture.end()
    finally:
        capture.process.kill()
        for server in one.values():
            server.stop()
    log = [json.loads(line) for line in (folder / "out" / "capture.jsonl").read_text().splitlines()]
    return SimpleNamespace(
        code=code, lines=capture.lines, log=log, began=began, numbers=captured(folder / "out"), out=folder / "out"
    )


def test_every_set_that_was_written_is_of_one_instant(story) -> None:
    assert story.code == 0
    assert (story.out / "END").exists()
    assert len(story.numbers) == len(story.log) > 100
    # In the pictures of damaged ones the number may be damaged, too.
    sound = [{name: number for name, number in row.items() if name != "garbage"} for row in story.numbers]
    assert [numbers for numbers in sound if len(set(numbers.values())) != 1] == []
    steps = [(b["sound"] - a["sound"]) % LENGTH for a, b in zip(story.numbers, story.numbers[1:], strict=False)]
    assert set(steps) == {1}, "the camera that was sound lost nothing"


@pytest.mark.parametrize("name", ["stopped", "killed", "garbage", "resized"])
def test_who_goes_is_left_out_told_and_back(story, name) -> None:
    absent = [line["frame"] for line in story.log if name in line["absent"]]
    last = [line["absent"] for line in story.log[-10:]]
    assert absent, "nothing happened to it"
    assert sum(name in row for row in last) == 0, f"not back: {story.lines}"
    told = [line for line in story.lines if line.startswith(f"{name} is")]
    if name == "garbage":
        return  # it never stops sending: what is damaged is left out until the next key picture
    assert len(told) == 2, told
    assert told[1].startswith(f"{name} is back")


def test_another_size_is_refused_with_the_sizes(story) -> None:
    (line,) = [line for line in story.lines if line.startswith("resized is refused")]
    assert "its pictures are 160 x 128, they were 320 x 240" in line


def test_damage_ends_at_the_next_key_picture(story) -> None:
    """Garbage in the middle of H.264: what the decoder refuses does not come.

    A picture that is lost without a trace is not told by the decoder: those that predict from it are wrong until then.
    """
    paths = sorted(story.out.glob("garbage/*.jpg"))
    assert len(paths) > 60
    wrong = []
    for path in paths:
        with Image.open(path) as image:
            found = np.asarray(image.convert("RGB"))
        number = story.numbers[int(path.stem)]["sound"]
        if np.abs(found.astype(int) - painted(grey(number, SIZE, 1), number)).mean() >= 4:
            wrong.append(int(path.stem))
    assert len(wrong) <= 10, "more than the pictures between two key pictures"
    assert not wrong or wrong[-1] - wrong[0] < 20


def test_a_server_that_accepts_and_sends_nothing_is_named(units, tmp_path) -> None:
    """The capture does not begin without it, and says which camera it is."""
    from gsstream_capture.capture import LiveRig
    from gsstream_capture.rig import read_rig

    from gsstream.core.errors import SourceError

    with socket.create_server(("127.0.0.1", 0)) as silent, Server({"a": units["a"]}, FPS, time.time()) as server:
        port = silent.getsockname()[1]
        url = f"rtsp://someone:secretword@127.0.0.1:{port}/x"
        calibration(tmp_path, ["a", "mute"], SIZE)
        rig = read_rig(rig_file(tmp_path, {"a": server.url("a"), "mute": url}, FPS))
        with LiveRig(rig, tmp_path) as live, pytest.raises(SourceError) as caught:
            live.first(4.5)
    told = str(caught.value)
    assert f"'mute' (rtsp://127.0.0.1:{port}/x): " in told
    assert "'a' (" not in told or "reports" in told
    assert "secretword" not in told


def test_a_password_reaches_no_file_and_no_line(units, tmp_path) -> None:
    import os

    with Server({"a": units["a"], "b": units["b"]}, FPS, time.time(), login="opener:pass/word77") as server:
        place = server.url("").rstrip("/").removeprefix("rtsp://")
        calibration(tmp_path, ["a", "b"], SIZE)
        rig = rig_file(
            tmp_path,
            {"a": f"rtsp://{LOGIN}@{place}/a", "b": f"rtsp://${{LOGIN}}@{place}/b"},
            FPS,
            each=", transport: udp",
        )
        # By arrival: there is nothing to wait for.
        rig.write_text("clock: arrival\n" + rig.read_text())
        capture = Capturing(rig, tmp_path / "out", environment=os.environ | {"LOGIN": LOGIN})
        capture.wait_for("paired by arrival")
        time.sleep(1)
        server.stop()
        capture.wait_for("a is gone")
        capture.process.send_signal(signal.SIGTERM)
        assert capture.end() == 0
    texts = {path: path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()}
    texts["said"] = "\n".join(capture.lines).encode()
    assert len(texts) > 10
    for secret in (b"opener", b"word77"):
        assert [str(path) for path, text in texts.items() if secret in text] == []


def test_mjpeg_and_files_are_cameras(tmp_path) -> None:
    """A camera of HTTP by arrival, and files that play at their rate by their own stamps."""
    from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

    from gsstream_capture.capture import run_capture
    from gsstream_capture.pictures import jpeg
    from gsstream_capture.rig import read_rig

    pictures = [jpeg(painted(grey(i, SIZE), i)[..., ::-1].copy(), 90) for i in range(100)]
    began = time.time()

    class Mjpeg(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
            self.end_headers()
            for _ in range(100):
                number = int((time.time() - began) * FPS) + 1
                time.sleep(max(0.0, began + number / FPS - time.time()))
                data = pictures[number % 100]
                head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                try:
                    self.wfile.write(head.encode() + data + b"\r\n")
                except OSError:
                    return

        def log_message(self, *_) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Mjpeg)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    calibration(tmp_path, ["web", "tape", "film"], SIZE)
    encoded(tmp_path / "tape", (painted(grey(i, SIZE), i) for i in range(60)), FPS, suffix="mp4")
    encoded(tmp_path / "film", (painted(grey(i, SIZE), i) for i in range(60)), FPS, suffix="avi")
    port = server.server_address[1]
    urls = {"web": f"http://127.0.0.1:{port}/?pw=secretword", "tape": "tape.mp4", "film": "film.avi"}
    rig = read_rig(rig_file(tmp_path, urls, FPS))
    said: list[str] = []
    report = run_capture(rig, tmp_path, tmp_path / "out", seconds=1.5, say=said.append, stopped=threading.Event())
    server.shutdown()
    assert "web: 320 x 240" in said[1]
    assert "paired by arrival; tape: 320 x 240, 10.0/s, paired by its own clock" in said[1]
    numbers = captured(tmp_path / "out")
    assert report.frames == len(numbers) >= 14
    assert {row["tape"] - row["film"] for row in numbers} == {0}, "files keep step"
    # By arrival a busy machine may be one picture off.
    assert len({(row["web"] - row["tape"]) % 100 for row in numbers if "web" in row}) <= 2
    assert "secretword" not in "".join(said)


def test_a_file_that_ends_ends_the_capture(tmp_path) -> None:
    from gsstream_capture.capture import run_capture
    from gsstream_capture.rig import read_rig

    calibration(tmp_path, ["a"], SIZE)
    encoded(tmp_path / "a", (painted(grey(i, SIZE), i) for i in range(45)), 15, suffix="mp4")
    rig = read_rig(rig_file(tmp_path, {"a": "a.mp4"}, 15))
    report = run_capture(rig, tmp_path, tmp_path / "out", seconds=None, say=lambda _: None, stopped=threading.Event())
    numbers = [row["a"] for row in captured(tmp_path / "out")]
    assert numbers == list(range(numbers[0], 45)) or numbers == list(range(numbers[0], 44))
    assert numbers[0] <= 1
    assert (report.ended, report.dropped) == ("", 0)
    assert number_of(painted(grey(3, SIZE), 337)) == 337
