"""A live stream in a real browser: what it shows, and what it says and does when something breaks or ends."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
import zlib

import pytest
from browser_runs import MESSAGE, PLAYER, ROOT, WITHOUT_WORKERS, needs_browser
from live_runs import HEADER, Growing, assert_playable, browsing, live_socket, packets_from, served
from moving_scenes import moving_packets

from gsstream.packet import StreamWriter
from gsstream.player.playback import Playback
from gsstream.serve.server import Server
from tests.flow import capture
from tests.flow.flow_runs import TINY, demo_copy

pytestmark = needs_browser
#: Seconds that an encoder may take on a machine that has much else to do.
SLOW = 120
#: The buffer of a page that decodes by itself.
BUFFER = f"{PLAYER}.link.stream.buffer"
#: Connect again at once: nobody waits for seconds here.
HASTE = "import('./live-socket.js').then((m) => { m.settings.pauses = [100]; })"


@pytest.fixture(scope="module")
def page():
    with browsing() as page:
        yield page


@pytest.fixture
def by_itself(page):
    """Pages that are opened meanwhile have no workers and decode on their own thread, where a test reaches it."""
    name = page.send(*WITHOUT_WORKERS[1:])["identifier"]
    yield
    page.send("Page.removeScriptToEvaluateOnNewDocument", {"identifier": name})


@pytest.fixture(scope="module")
def packets():
    return moving_packets(seed=3, frames=40, number=80, nodes=20, key_at=20)


def says(page, words: str) -> str:
    page.until(f"{MESSAGE}.includes({words!r})", 20)
    text = page.evaluate(MESSAGE)
    assert "\n" not in text
    return text


def shows(page, frame: int, seconds: float = 20) -> None:
    page.until(f"{PLAYER}?.frame === {frame}", seconds)


def test_the_newest_frame_is_shown_as_it_comes(page, packets, tmp_path):
    with Server(tmp_path / "s.gss", live=True, port=0) as server:
        page.go(server.url)
        says(page, "The stream is not there yet.")
        stream = Growing(tmp_path / "s.gss")
        stream.write(packets[:10], pause=0.05)
        shows(page, 9)
        assert page.evaluate(MESSAGE) == ""
        latency = page.evaluate(f"{PLAYER}.latency.frames")
        assert page.evaluate(f"{ROOT}.querySelector('.seek').hidden")
        # Whoever comes later begins at the last key packet, and sees the same state.
        stream.write(packets[10:25])
        page.go(server.url)
        shows(page, 24)
        assert page.evaluate(f"{PLAYER}.first") == 20
        state = page.evaluate(f"{PLAYER}.scene().then(({{ means }}) => Array.from(means))")
        page.until(f"{PLAYER}.statistics.drawn > 0", 30)
        assert page.evaluate(f"{PLAYER}.latency.frames") == [], "what was written before it came is not late"
        (tmp_path / "sound.gss").write_bytes((tmp_path / "s.gss").read_bytes())
        with Playback(tmp_path / "sound.gss") as playback:
            assert state == pytest.approx(playback.state_at(24).means.ravel().tolist(), abs=0)
    assert latency
    assert all(-50 < entry["came"] <= entry["drawn"] < 20_000 for entry in latency)
    says(page, "trying again")
    assert page.messages == []


def test_a_pause_is_caught_up_with_and_a_sleep_too(page, packets, tmp_path):
    stream = Growing(tmp_path / "s.gss")
    stream.write(packets[:3])
    with Server(tmp_path / "s.gss", live=True, port=0) as server:
        page.go(server.url)
        shows(page, 2)
        page.evaluate(f"{PLAYER}.pause()")
        stream.write(packets[3:6])
        received = page.evaluate(f"{PLAYER}.buffer.received")
        time.sleep(0.3)
        assert page.evaluate(f"{PLAYER}.frame") == 2
        page.evaluate(f"{PLAYER}.play()")
        shows(page, 5)
        assert page.evaluate(f"{PLAYER}.buffer.received") - received == sum(len(p.data) for p in packets[3:6]) + 16
        page.evaluate("{ const end = performance.now() + 1000; while (performance.now() < end); }")
        stream.write(packets[6:30])
        shows(page, 29)
        assert page.evaluate(MESSAGE) == ""


def test_a_page_that_is_not_shown_takes_no_more_than_its_share(page, by_itself, packets, tmp_path):
    """The limit is lowered: a hidden page gets no pictures to draw, and what waits for it must not grow."""
    stream = Growing(tmp_path / "s.gss")
    stream.write(packets[:2])
    with Server(tmp_path / "s.gss", live=True, port=0) as server:
        page.go(server.url)
        shows(page, 1)
        page.evaluate(f"{{ const buffer = {BUFFER}; buffer.most = 3000; buffer.feed = () => {{}}; }}")
        stream.write(packets[2:19], pause=0.01)
        page.until(f"{BUFFER}.asleep")
        most = 3000 + max(len(p.data) for p in packets)
        assert page.evaluate(f"{BUFFER}.queue.reduce((sum, p) => sum + p.data.length, 0)") <= most
        page.evaluate(f"{{ delete {BUFFER}.feed; {BUFFER}.feed(); }}")
        shows(page, 18)


def test_a_server_that_was_killed_is_told_and_taken_up_again(page, by_itself, packets, tmp_path):
    stream = Growing(tmp_path / "s.gss")
    stream.write(packets[:5])
    with served(tmp_path / "s.gss", "--live", "--port", 0) as (url, process):
        page.go(url)
        shows(page, 4)
        page.evaluate(HASTE)
        process.kill()
        assert "trying again" in says(page, "The connection to the server is cut")
        says(page, "No live stream answers at 127.0.0.1")
    stream.write(packets[5:8])
    received = page.evaluate(f"{PLAYER}.buffer.received")
    with Server(tmp_path / "s.gss", live=True, port=int(url.strip("/").split(":")[-1])):
        shows(page, 7)
        page.until(f"{MESSAGE} === ''")
        # The header and the three packets that the viewer lacked.
        assert page.evaluate(f"{PLAYER}.buffer.received") - received == 16 + sum(len(p.data) for p in packets[5:8])


def test_another_stream_in_its_place_is_shown(page, packets, tmp_path):
    Growing(tmp_path / "s.gss").write(packets[:5])
    with Server(tmp_path / "s.gss", live=True, port=0) as server:
        page.go(server.url)
        shows(page, 4)
        (tmp_path / "s.gss").unlink()
        says(page, "The stream is not there yet.")
        Growing(tmp_path / "s.gss").write(moving_packets(seed=4, frames=3, number=30, nodes=9, key_at=9))
        shows(page, 2)
        assert page.evaluate(f"{PLAYER}.state.number") < 60


def test_a_damaged_packet_stops_the_picture_until_the_next_key(page, packets, tmp_path):
    stream = Growing(tmp_path / "s.gss")
    broken = bytearray(packets[3].data)
    broken[-1] ^= 1
    stream.write(packets[:3])
    with Server(tmp_path / "s.gss", live=True, port=0) as server:
        page.go(server.url)
        shows(page, 2)
        stream.file.write(broken)
        stream.write(packets[4:6])
        says(page, "frame 3 is damaged")
        assert page.evaluate(f"{PLAYER}.frame") == 2
        stream.write(packets[6:22])
        shows(page, 21)
        assert page.evaluate(MESSAGE) == ""


def test_the_end_and_silence_are_told(page, by_itself, packets, tmp_path):
    with Server(tmp_path / "s.gss", live=True, port=0) as server:
        with StreamWriter.open(tmp_path / "s.gss") as writer:
            for packet in packets[:3]:
                writer.append(packet)
            page.go(server.url)
            shows(page, 2)
            page.evaluate("import('./live.js').then((m) => { m.settings.quiet = 500; })")
            says(page, "No new frame came for")
        says(page, "The stream has ended.")
        # Somebody who comes after the end sees the last frame, and why it does not move.
        page.go(server.url)
        shows(page, 2)
        says(page, "The stream has ended.")
    # The server goes, too, as that of a run does: nothing is missed, and nothing is tried again.
    page.until(f"{BUFFER}.socket.socket === null")
    time.sleep(1.2)
    assert page.evaluate(MESSAGE) == "The stream has ended."
    assert page.evaluate(f"[{BUFFER}.socket.socket, {BUFFER}.socket.timer]") == [None, None]


@pytest.mark.parametrize("case", ["no stream", "newer", "token", "wrong token", "viewers", "nobody", "a recording"])
def test_what_is_wrong_is_said_in_one_sentence(page, packets, tmp_path, case):
    file = tmp_path / "s.gss"
    Growing(file).write(packets[:3])
    options = {"token": "secret"} if "token" in case else {"max_viewers": 0} if case == "viewers" else {}
    expected = {
        "no stream": "ot a gsstream file",
        "newer": "cannot be read",
        "token": "needs a token",
        "wrong token": "needs a token",
        "viewers": "0 viewers are watching already",
        "nobody": "No live stream answers",
        "a recording": "404",
    }[case]
    if case == "no stream":
        file.write_bytes(b"<!doctype html>........")
    elif case == "newer":
        head = bytearray(HEADER)
        head[8] += 1
        head[12:16] = zlib.crc32(head[:12]).to_bytes(4, "little")
        file.write_bytes(head + packets[0].data)
    elif case == "a recording":
        file.unlink()
    with Server(file, live=case != "a recording", port=0, **options) as server:
        url = server.url.split("?")[0] + ("?token=other" if case == "wrong token" else "")
        page.go(url + "?src=ws://127.0.0.1:9/live" if case == "nobody" else url)
        says(page, expected)
    page.messages.clear()  # browsers report failed requests by themselves


def test_a_server_that_sends_no_stream_is_told(page, packets):
    """A newer stream will not become older: the page does not try again. Anything else may have been an accident."""
    from websockets.sync.server import serve

    newer = bytearray(HEADER)
    newer[10] += 1
    newer[12:16] = zlib.crc32(newer[:12]).to_bytes(4, "little")
    cases = [
        ([bytes(newer)], "newer than this player"),
        ([b"<!doctype html>"], "ot a gsstream file"),
        ([HEADER, packets[1].data], "without the one before it; trying again"),
        ([HEADER, packets[0].data, packets[1].data[:-1]], "no stream; trying again"),
        ([HEADER, packets[0].data, b"\x07" * 40], "damaged"),
        (["{", "7", '{"state": 5}', HEADER], "No frame is encoded yet"),
    ]
    for messages, words in cases:

        def answer(viewer, messages=messages):
            for message in messages:
                viewer.send(message)
            for _ in viewer:
                pass

        with serve(answer, "127.0.0.1", 0) as server, Server("none.gss", live=True, port=0) as page_server:
            threading.Thread(target=server.serve_forever).start()
            page.go(f"{page_server.url}?src=ws://127.0.0.1:{server.socket.getsockname()[1]}/live")
            says(page, words)
            server.shutdown()
    assert page.messages == []


def test_the_token_reaches_the_socket_and_the_ranges(page, packets, tmp_path):
    Growing(tmp_path / "s.gss").write(packets[:30])
    for live, first in ((True, 20), (False, 0)):
        with Server(tmp_path / "s.gss", live=live, port=0, token="se cret&") as server:
            page.go(server.url)
            page.until(f"{PLAYER}?.state")
            assert page.evaluate(f"{PLAYER}.first") == first
            if not live:
                page.evaluate(f"{PLAYER}.seek(29)")
            shows(page, 29)


def test_cameras_to_browser_with_real_processes(page, tmp_path):
    """A writer adds frames to a folder, a run encodes and serves them, the page shows them.

    Then the run is killed, which the page says, and continued, which the page shows; the end is told.
    """
    finished = demo_copy(tmp_path / "scene", frames=5)
    capture.begin(finished, tmp_path / "watched")
    settings = {**TINY, "first_frame.max_iterations": 8, "stream.epochs": 1}
    out = tmp_path / "run"
    run = [
        sys.executable, "-c", "from gsstream.cli.main import main; main()", "run", "--method", "dense",
        "--source", f"watch:{tmp_path / 'watched'}", "--out", str(out), "--scale", "0.5", "--quiet", "--no-pictures",
        *(part for key, value in settings.items() for part in ("--set", f"{key}={value}")),
    ]  # fmt: skip

    def add(frames: range) -> None:
        for t in frames:
            for camera in json.loads((finished / "cameras.json").read_text())["cameras"]:
                target = tmp_path / "watched" / (camera["frames"] % t)
                target.parent.mkdir(parents=True, exist_ok=True)
                capture.put(finished / (camera["frames"] % t), target, 0, False)

    with served(out, "--live", "--port", 0) as (url, _):
        page.go(url)
        says(page, "The stream is not there yet.")
        with subprocess.Popen(run) as encoder:
            try:
                add(range(3))
                shows(page, 2, SLOW)
            finally:
                encoder.send_signal(signal.SIGKILL)
        says(page, "The encoder stopped before the stream was finished.")
        add(range(3, 5))
        (tmp_path / "watched" / "END").touch()
        # In the same process this time: whoever connects before it ends gets all that was written.
        with subprocess.Popen([*run, "--resume", "--serve", "0"], stdout=subprocess.PIPE, text=True) as encoder:
            assert encoder.stdout is not None
            with live_socket(encoder.stdout.readline().split()[-1]) as viewer:
                got, _ = packets_from(viewer, until=4, seconds=SLOW)
            assert encoder.wait(timeout=SLOW) == 0
        shows(page, 4)
        says(page, "The stream has ended.")
    assert assert_playable(got)[-1] == 4
    assert page.messages == []
