"""``gsstream open`` against viewers that are no browsers: what they get, who is let in, and what is not served."""

from __future__ import annotations

import contextlib
import http.client
import json
import socket
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from live_runs import HEADER, Growing, assert_playable, frame_of, live_socket, packets_from, served
from moving_scenes import moving_packets
from websockets.exceptions import ConnectionClosed, InvalidStatus

from gsstream.cli.main import run_command
from gsstream.core.errors import InputError, OutputError
from gsstream.packet import EncodedPacket, PacketKind, StreamWriter
from gsstream.packet.base import build_packet
from gsstream.serve.server import Server


@pytest.fixture(scope="module")
def packets():
    return moving_packets(seed=3, frames=12, number=80, nodes=20, key_at=7)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory, packets):
    """A finished stream, served as a recording with a token, and what else might be asked for beside it."""
    folder = tmp_path_factory.mktemp("served")
    with StreamWriter.open(folder / "stream.gss") as writer:
        for packet in packets:
            writer.append(packet)
    (folder / "secret.txt").write_text("secret")
    with Server(folder / "stream.gss", port=0, token="to ken", origins=["https://example.org"]) as server:
        yield folder, server.url


def get(url: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    request = urllib.request.Request(url, headers={name.replace("_", "-"): value for name, value in headers.items()})
    try:
        with urllib.request.urlopen(request, timeout=10) as answer:
            return answer.status, dict(answer.headers), answer.read()
    except urllib.error.HTTPError as error:
        return error.code, dict(error.headers), error.read()


def at(url: str, path: str) -> str:
    return url.replace("/?", f"/{path}?")


def test_a_recording_is_served_by_ranges(recorded):
    folder, url = recorded
    data = (folder / "stream.gss").read_bytes()
    assert get(at(url, "stream.gss"))[::2] == (200, data)
    status, headers, body = get(at(url, "stream.gss"), Range="bytes=100-299")
    assert (status, body, headers["content-range"]) == (206, data[100:300], f"bytes 100-299/{len(data)}")
    assert get(at(url, "stream.gss"), Range="bytes=-12")[2] == data[-12:]
    assert get(at(url, "stream.gss"), Range=f"bytes={len(data)}-")[0] == 416
    manifest = json.loads(get(at(url, "stream.json"))[2])
    assert [s["frames"] for s in manifest["segments"]] == [[0, 6], [7, 11]]
    (first, middle), (start, end) = (s["range"] for s in manifest["segments"])
    assert (first, middle + 1) == (0, start)
    assert data[start] == PacketKind.KEY
    assert data[end + 1] == PacketKind.INDEX


@pytest.mark.parametrize(
    "path",
    [
        "/../secret.txt",
        "/%2e%2e/secret.txt",
        "/..%2fsecret.txt",
        "/....//secret.txt",
        "/secret.txt",
        "//etc/passwd",
        "/%2fetc%2fpasswd",
        "/..%5c..%5csecret.txt",
        "/changes/../../serve/app.py",
        "/../serve/app.py",
        "/%00",
        "/stream.gss/../secret.txt",
        "/stream.gss%00.js",
        "/changes/",
        "/a" * 2000,
    ],
)
def test_nothing_but_the_page_and_the_stream_is_served(recorded, path):
    """The path goes to the server as it stands here: an ordinary client would mend it first."""
    _, url = recorded
    connection = http.client.HTTPConnection(urlsplit(url).netloc, timeout=10)
    connection.putrequest("GET", path + "?token=to%20ken", skip_host=False)
    connection.endheaders()
    answer = connection.getresponse()
    assert answer.status == 404, answer.read()
    assert b"secret" not in answer.read()


def test_methods_that_change_things_are_refused(recorded):
    _, url = recorded
    for method in ("PUT", "POST", "DELETE"):
        request = urllib.request.Request(at(url, "stream.gss"), data=b"x", method=method)
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(request, timeout=10)
        assert refused.value.code == 405


def test_the_token_guards_the_stream_and_not_the_page(recorded):
    _, url = recorded
    bare = url.split("?")[0]
    assert get(bare)[0] == get(f"{bare}element.js")[0] == 200
    for query in ("", "?token=", "?token=other", "?token=to%20ken%20", "?token=%ff"):
        for name in ("stream.gss", "stream.json"):
            status, _, body = get(f"{bare}{name}{query}")
            assert (status, b"token" in body) == (401, True)
        with pytest.raises(InvalidStatus) as refused, live_socket(bare + query):
            pass
        assert refused.value.response.status_code == 401
    with live_socket(url) as viewer:
        assert json.loads(viewer.recv(timeout=5))["state"] == "live"


def test_pages_from_elsewhere_and_other_names_are_refused(recorded):
    """A page that makes a browser connect, also one that gave its own name the address of this machine."""
    _, url = recorded
    here = url.split("/?")[0]
    for origin in ("https://evil.example", "null", here.replace("http", "https").replace("127", "128"), ""):
        with pytest.raises(InvalidStatus) as refused, live_socket(url, additional_headers={"Origin": origin}):
            pass
        assert refused.value.response.status_code == 403
    for origin in (here, "https://example.org"):
        with live_socket(url, additional_headers={"Origin": origin}) as viewer:
            viewer.recv(timeout=5)
    assert get(at(url, "stream.gss"), Host="evil.example")[0] == 403
    assert get(url, Host="evil.example:80")[0] == get(url, Host="")[0] == 403
    assert get(url, Host="localhost:1")[0] == get(url, Host="[::1]:1")[0] == 200
    allowed = get(at(url, "stream.gss"), Origin="https://example.org")[1]
    assert allowed["access-control-allow-origin"] == "https://example.org"
    assert "access-control-allow-origin" not in get(at(url, "stream.gss"), Origin="https://evil.example")[1]
    assert allowed["referrer-policy"] == "no-referrer"


def test_whoever_joins_gets_header_last_key_what_follows_and_then_what_comes(tmp_path, packets):
    with Server(tmp_path / "s.gss", live=True, port=0) as server, live_socket(server.url) as early:
        assert json.loads(early.recv(timeout=5))["state"] == "waiting"
        stream = Growing(tmp_path / "s.gss")
        stream.write(packets[:10], pause=0.01)
        first, _ = packets_from(early, until=9)
        with live_socket(server.url) as late:
            joined, _ = packets_from(late, until=9)
            stream.file.write(packets[10].data[:-1])
            time.sleep(0.1)
            stream.file.write(packets[10].data[-1:])
            new, texts = packets_from(late, until=10)
    assert first == [HEADER, *(p.data for p in packets[:10])]
    assert joined == [HEADER, *(p.data for p in packets[7:10])]
    assert new == [packets[10].data]
    assert assert_playable(first) == list(range(10))
    assert assert_playable([*joined, *new]) == [7, 8, 9, 10]
    assert [t["frame"] for t in texts] == [10]
    assert abs(texts[0]["written"] / 1000 - time.time()) < 60


def test_whoever_comes_again_gets_only_what_it_lacks(tmp_path, packets):
    Growing(tmp_path / "s.gss").write(packets[:11])
    with Server(tmp_path / "s.gss", live=True, port=0) as server:

        def rejoin(frame: int, head: str) -> list[int | None]:
            from websockets.sync.client import connect

            address = f"{server.url.replace('http', 'ws', 1)}live?after={frame}&packet={head}"
            with connect(address, proxy=None) as viewer:
                got, _ = packets_from(viewer, until=10)
            assert got[0] == HEADER
            return [frame_of(packet) for packet in got[1:]]

        assert rejoin(8, packets[8].data[:16].hex()) == [9, 10]
        fresh = [7, 8, 9, 10]
        assert rejoin(8, packets[9].data[:16].hex()) == fresh, "not the packet that the viewer says it is"
        assert rejoin(3, packets[3].data[:16].hex()) == fresh, "the key packet is nearer"
        assert rejoin(99, "00") == rejoin(-1, "") == rejoin(8, "zz") == fresh


def test_a_damaged_packet_is_left_out_until_the_next_key(tmp_path, packets):
    stream = Growing(tmp_path / "s.gss")
    broken = bytearray(packets[2].data)
    broken[-1] ^= 1
    with Server(tmp_path / "s.gss", live=True, port=0) as server, live_socket(server.url) as viewer:
        stream.write(packets[:2])
        stream.file.write(broken)
        stream.write(packets[3:5])
        got, texts = packets_from(viewer, until=1)
        while texts[-1].get("state") != "damaged":
            texts.append(json.loads(viewer.recv(timeout=5)))
        assert "frame 2" in texts[-1]["detail"]
        stream.write(packets[5:9])
        more, _ = packets_from(viewer, until=8)
    assert assert_playable(got + more) == [0, 1, 7, 8]


def test_no_more_viewers_than_allowed_and_a_place_becomes_free(tmp_path, packets):
    Growing(tmp_path / "s.gss").write(packets[:3])
    with Server(tmp_path / "s.gss", live=True, port=0, max_viewers=2) as server, contextlib.ExitStack() as stack:
        first, second = (stack.enter_context(live_socket(server.url)) for _ in range(2))
        packets_from(first, until=2)
        packets_from(second, until=2)
        with pytest.raises(ConnectionClosed) as closed, live_socket(server.url) as third:
            third.recv(timeout=5)
        assert (closed.value.rcvd.code, closed.value.rcvd.reason) == (1013, "2 viewers are watching already")
        first.close()
        with live_socket(server.url) as third:
            packets_from(third, until=2)


def test_what_viewers_say_does_no_harm(tmp_path, packets):
    Growing(tmp_path / "s.gss").write(packets[:3])
    with Server(tmp_path / "s.gss", live=True, port=0) as server:
        with live_socket(server.url) as viewer:
            for text in ("", "[", "[" * 1000, "1", '"ping"', '{"ping": "x"}', '{"ping": NaN}', b"\xff"):
                viewer.send(text)
            viewer.send('{"ping": 5}')
            _, texts = packets_from(viewer, until=2)
            while texts[-1].get("pong") != 5:
                texts.append(json.loads(viewer.recv(timeout=10)))
            assert abs(texts[-1]["now"] / 1000 - time.time()) < 10
        with live_socket(server.url) as viewer:
            viewer.send("x" * 2000)
            with pytest.raises(ConnectionClosed) as closed:
                packets_from(viewer, until=99, seconds=5)
        assert closed.value.rcvd.code == 1009
        with live_socket(server.url) as viewer:
            packets_from(viewer, until=2)


def resident(pid: int) -> float:
    """Megabytes of memory of a process."""
    line = next(x for x in Path(f"/proc/{pid}/status").read_text().splitlines() if x.startswith("VmRSS"))
    return int(line.split()[1]) / 1024


@contextlib.contextmanager
def sleeper(url: str) -> Iterator[Any]:
    """A viewer that takes nothing but what it is told to take, and has little room."""
    with socket.socket() as plain:
        plain.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
        plain.connect(("127.0.0.1", urlsplit(url).port))
        with live_socket(url, sock=plain, max_queue=2, close_timeout=0.1) as viewer:
            yield viewer


def test_ten_viewers_of_which_one_sleeps(tmp_path):
    """10 MB as fast as nine take them, who get every packet; the tenth costs no memory, and wakes to a key packet.

    Nor does a server that is told to stop wait for one who sleeps.
    """
    frames = 201
    noise = np.random.default_rng(1).bytes(50_000)
    packets = [large(frame, noise) for frame in range(2 * frames)]
    got: list[list[bytes]] = [[] for _ in range(9)]

    def watch(into: list[bytes], url: str) -> None:
        with live_socket(url) as viewer:
            packets_from(viewer, until=frames - 1, seconds=60, into=into)

    with served(tmp_path / "s.gss", "--live", "--port", 0) as (url, process):
        stream = Growing(tmp_path / "s.gss")
        stream.write(packets[:1])
        with sleeper(url) as tenth:
            slow, _ = packets_from(tenth, until=0)
            threads = [threading.Thread(target=watch, args=(into, url)) for into in got]
            for thread in threads:
                thread.start()
            wait_for(lambda: all(len(messages) > 1 for messages in got))
            before = resident(process.pid)
            for frame in range(1, frames, 10):
                stream.write(packets[frame : frame + 10])
                wait_for(lambda last=frame: all(len(messages) > last for messages in got))
            for thread in threads:
                thread.join()
            grown = resident(process.pid) - before
            more, _ = packets_from(tenth, until=frames - 1, seconds=30)
        with sleeper(url):
            stream.write(packets[frames:])
            time.sleep(0.5)
            process.terminate()
            process.wait(timeout=8)
    for messages in got:
        assert frames_of_sound(messages) == list(range(frames))
    woken = frames_of_sound(slow + more)
    assert woken[-1] == frames - 1
    assert len(woken) < frames // 2, "most of what it slept through is left out"
    assert grown < 5, f"{grown:.0f} MB more after 10 MB were sent to each of ten"


def wait_for(condition: Callable[[], bool], seconds: float = 30) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "the viewers do not get their packets"
        time.sleep(0.005)


def large(frame: int, noise: bytes) -> EncodedPacket:
    """A packet as far as a server looks at it; every tenth is a key packet."""
    key = frame % 10 == 0
    return build_packet(PacketKind.KEY if key else PacketKind.DELTA, frame, [("meta" if key else "gates", noise)])


def frames_of_sound(messages: list[bytes]) -> list[int]:
    """Like assert_playable, by the headers of packets alone; returns the frames."""
    assert messages[0] == HEADER
    frames: list[int] = []
    for packet in messages[1:]:
        frame = frame_of(packet)
        assert packet[0] == PacketKind.KEY or frame == frames[-1] + 1
        frames.append(frame)
    return frames


def test_an_address_in_use_is_told_and_costs_no_run(tmp_path, capsys):
    with Server(tmp_path / "s.gss", live=True, port=0) as server:
        with pytest.raises(OutputError, match=f"127.0.0.1:{server.port}"):
            Server(tmp_path / "s.gss", live=True, port=server.port)
        (tmp_path / "run").mkdir()
        (tmp_path / "run" / "stream.gss").write_bytes(b"an earlier run")
        run = ["run", "--source", "demo", "--out", str(tmp_path / "run"), "--method", "hold", "--overwrite", "--quiet"]
        assert run_command([*run, "--serve", str(server.port)]) == 2
    assert "cannot serve" in capsys.readouterr().err
    assert (tmp_path / "run" / "stream.gss").read_bytes() == b"an earlier run"


def test_what_cannot_be_served_is_told(tmp_path, capsys, monkeypatch):
    assert run_command(["open", str(tmp_path / "none")]) == 2
    assert "no stream at" in capsys.readouterr().err
    for origin in ("example.org", "ftp://example.org", "https://example.org/", "https://", "*"):
        with pytest.raises(InputError, match="--origin"):
            Server(tmp_path / "s.gss", port=0, origins=[origin])
    with pytest.warns(UserWarning, match="--token"):
        Server(tmp_path / "s.gss", port=0, host="0.0.0.0").close()
    monkeypatch.setattr("gsstream.serve.server.importlib.util.find_spec", lambda _: None)
    with pytest.raises(InputError, match=r"pip install 'gsstream\[serve\]'"):
        Server(tmp_path / "s.gss", port=0)
