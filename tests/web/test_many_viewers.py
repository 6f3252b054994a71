"""Streams for thousands: a cache asks its server once, live parts say what the stream says, a relay hands it on."""

from __future__ import annotations

import fnmatch
import hashlib
import http.client
import json
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from urllib.parse import urlsplit

import pytest
import stores
from browser_runs import MESSAGE, PLAYER, needs_browser
from caching_proxy import origin, proxy, rules
from hypothesis import given, settings
from hypothesis import strategies as st
from live_runs import HEADER, Growing, assert_playable, browsing, live_socket, packets_from, served
from moving_scenes import moving_packets
from node_runs import needs_node, node

from gsstream.cli.main import run_command
from gsstream.core.errors import PacketError
from gsstream.packet import PacketKind, StreamWriter
from gsstream.packet.base import FILE_HEADER, parse_header
from gsstream.serve import parts as live
from gsstream.serve import relay
from gsstream.serve.cursor import Cursor
from gsstream.serve.follow import Follower
from gsstream.serve.package import package
from gsstream.serve.parts import LivePackage
from gsstream.store.place import Folder

#: Viewers, a request at a time each.
VIEWERS = 1000


@pytest.fixture(scope="module")
def packets():
    return moving_packets(seed=3, frames=24, number=40, nodes=10, sh_rest=0, key_at=8)


def get(address: str, path: str, **headers: str) -> tuple[int, bytes, dict[str, str]]:
    parts = urlsplit(address)
    connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=120)
    try:
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.read(), dict(answer.headers)
    finally:
        connection.close()


def test_a_thousand_viewers_of_a_page_cost_its_server_one_request_a_file(packets, tmp_path: Path) -> None:
    with StreamWriter.open(tmp_path / "s.gss") as writer:
        for packet in packets:
            writer.append(packet)
    package(tmp_path / "s.gss", tmp_path / "page", join_every=0)
    manifest = json.loads((tmp_path / "page" / "stream.json").read_text())
    segments = [f"/{segment['file']}" for segment in manifest["segments"]]
    names = ["/index.html", "/element.js", *segments]
    with origin(tmp_path / "page") as (server, sent), proxy(server) as cache, ThreadPoolExecutor(16) as pool:
        asked = [names[viewer % len(names)] for viewer in range(VIEWERS)]
        answers = list(pool.map(lambda name: get(cache, name), asked))
        assert {status for status, _, _ in answers} == {200}
        for name, (_, data, headers) in zip(asked, answers, strict=True):
            assert data == (tmp_path / "page" / name[1:]).read_bytes()
            assert headers["Access-Control-Allow-Origin"] == "*"
            assert ("immutable" in headers["Cache-Control"]) == name.startswith("/segments/")
        whole = (tmp_path / "page" / segments[0][1:]).read_bytes()
        status, data, headers = get(cache, segments[0], Range="bytes=16-99")
        assert (status, data, headers["Content-Range"]) == (206, whole[16:100], f"bytes 16-99/{len(whole)}")
        assert get(cache, segments[0], **{"If-None-Match": headers["ETag"]})[:2] == (304, b"")
        assert sent == {name[1:]: 1 for name in names}


def test_many_viewers_of_a_live_page_cost_its_server_two_requests_a_second(packets, tmp_path: Path) -> None:
    """Each asks for the manifest and for what is new in it; the server hears of one of them."""
    growing, last = Growing(tmp_path / "s.gss"), 0
    package = LivePackage(Follower(tmp_path / "s.gss"), Folder(tmp_path / "page"))
    with origin(tmp_path / "page") as (server, sent), proxy(server) as cache, ThreadPoolExecutor(16) as pool:

        def look(_: int) -> None:
            _, manifest, headers = get(cache, "/stream.json")
            assert headers["Cache-Control"] == live.FOR_A_SECOND
            status, _, headers = get(cache, f"/{json.loads(manifest)['parts'][-1]['file']}")
            assert (status, headers["Cache-Control"]) == (200, live.FOR_EVER)

        began = time.monotonic()
        while last < 16:
            growing.write(packets[last : last + 4])
            last += 4
            package.look()
            list(pool.map(look, range(VIEWERS // 8)))
        seconds = time.monotonic() - began
    growing.file.close()
    assert sent["stream.json"] + sent["stream.json again"] <= 1 + seconds
    parts = {name: count for name, count in sent.items() if name.startswith("parts/")}
    assert set(parts.values()) == {1}


def written(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (folder / "parts").glob("*.gss")}


class Viewer:
    """Reads a live page as the player does, in Python."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.last, self.got = folder, None, list[bytes]()

    def look(self) -> None:
        parts = json.loads((self.folder / "stream.json").read_text())["parts"]
        known = [place for place, part in enumerate(parts) if part["file"] == self.last]
        begin = known[0] + 1 if known else max(place for place, part in enumerate(parts) if part["key"])
        for part in parts[begin:]:
            data = (self.folder / part["file"]).read_bytes()
            assert len(data) == part["bytes"]
            if self.last is None or not known:
                self.got.append(HEADER)
                known = [0]
            at = FILE_HEADER.size
            while at < len(data):
                end = at + 16 + parse_header(data[at:], at).body
                self.got.append(data[at:end])
                at = end
            self.last = part["file"]


@settings(max_examples=40)
@given(steps=st.lists(st.tuples(st.integers(1, 6), st.booleans()), min_size=1, max_size=10))
def test_whenever_a_viewer_looks_he_can_play_what_he_gets(packets, tmp_path_factory, steps) -> None:
    folder = tmp_path_factory.mktemp("live")
    growing, package = Growing(folder / "s.gss"), LivePackage(Follower(folder / "s.gss"), Folder(folder / "page"))
    early, at, names = Viewer(folder / "page"), 0, dict[str, bytes]()
    for count, looks in steps:
        growing.write(packets[at : at + count])
        at = min(at + count, len(packets))
        assert not package.look()
        if looks:
            early.look()
        now = written(folder / "page")
        assert all(now[name] == data for name, data in names.items()), "a part changed under its name"
        names = now
    late = Viewer(folder / "page")
    late.look()
    early.look()
    for viewer in (early, late):
        assert assert_playable(viewer.got)[-1] == at - 1
    key = max(place for place, packet in enumerate(packets[:at]) if packet.kind == PacketKind.KEY)
    assert late.got[1:] == [packet.data for packet in packets[key:at]]
    growing.file.close()


def test_parts_that_nobody_needs_go(packets, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "KEPT", 0.0)
    growing = Growing(tmp_path / "s.gss")
    package = LivePackage(Follower(tmp_path / "s.gss"), Folder(tmp_path / "page"))
    package.write_page()
    assert (tmp_path / "page" / "index.html").is_file()
    for number, packet in enumerate([*packets[:9], packets[0]]):
        if number == 9:  # the run begins again in the file
            growing.file.close()
            (tmp_path / "s.gss").unlink()
            growing = Growing(tmp_path / "s.gss")
        growing.write([packet])
        package.look()
        time.sleep(0.01)
    package.look()
    assert set(written(tmp_path / "page")) == {
        part["file"].removeprefix("parts/")
        for part in json.loads((tmp_path / "page" / "stream.json").read_text())["parts"]
    }
    (tmp_path / "page" / "parts" / "notes.gss").write_bytes(b"mine")
    LivePackage(Follower(tmp_path / "s.gss"), Folder(tmp_path / "page")).write_page()
    assert (tmp_path / "page" / "parts" / "notes.gss").exists()
    growing.file.close()


@needs_node
def test_the_player_hears_of_parts_what_it_hears_of_a_socket(packets, tmp_path: Path) -> None:
    growing = Growing(tmp_path / "s.gss")
    package = LivePackage(Follower(tmp_path / "s.gss"), Folder(tmp_path / "page"))
    growing.write(packets[:3])
    package.look()

    def write() -> None:
        while not any("/parts/" in line for line in asked):  # the player has begun
            time.sleep(0.05)
        for begin in range(3, len(packets), 5):
            growing.write(packets[begin : begin + 5])
            package.look()
            time.sleep(0.3)
        growing.file.close()
        StreamWriter.open(tmp_path / "s.gss", resume=True).close()
        assert package.look(), "the stream has ended"

    code = """
    const { LiveParts } = await load("live-parts.js");
    const heard = [], states = [];
    const digest = async (data) => Buffer.from(await crypto.subtle.digest("SHA-256", data)).toString("hex");
    await new Promise((done) => {
      const buffer = { url: given, opened() {}, trouble: (text) => states.push(text) };
      buffer.came = (data) => heard.push(data);
      buffer.said = ({ state }) => {
        states.push(state);
        if (state === "ended") done();
      };
      new LiveParts(buffer).start();
    });
    return { heard: await Promise.all(heard.map(digest)), states: [...new Set(states)] };
    """
    with stores.web_server(tmp_path / "page") as (address, asked):
        thread = threading.Thread(target=write)
        thread.start()
        found = node(code, f"{address}/stream.json", tmp_path)
        thread.join()
    wanted = [HEADER, *(packet.data for packet in packets)]
    assert found["heard"] == [hashlib.sha256(data).hexdigest() for data in wanted]
    assert found["states"] == ["live", "ended"]


@needs_browser
def test_the_page_follows_parts_and_pauses(packets, tmp_path: Path) -> None:
    growing = Growing(tmp_path / "s.gss")
    package = LivePackage(Follower(tmp_path / "s.gss"), Folder(tmp_path / "page"))
    package.write_page()
    growing.write(packets[:10])
    package.look()
    with stores.web_server(tmp_path / "page") as (address, _), browsing() as page:
        page.go(f"{address}/index.html")
        page.until(f"{PLAYER}?.frame === 9", 60)
        page.evaluate(f"{PLAYER}.pause()")
        growing.write(packets[10:14])
        package.look()
        page.evaluate(f"{PLAYER}.play()")
        page.until(f"{PLAYER}?.frame === 13", 60)
        growing.write(packets[14:])
        package.look()
        page.until(f"{PLAYER}?.frame === {len(packets) - 1}", 60)
        assert page.evaluate(f"{PLAYER}.first") == 8
        growing.file.close()
        StreamWriter.open(tmp_path / "s.gss", resume=True).close()
        package.look()
        page.until(f"{MESSAGE} === 'The stream has ended.'", 60)
        assert page.messages == []


def test_a_live_page_goes_to_a_store_with_its_headers(packets, tmp_path: Path) -> None:
    with StreamWriter.open(tmp_path / "s.gss") as writer:
        for packet in packets[:4]:
            writer.append(packet)
    with stores.bucket("live-page", tmp_path / "cache") as bucket:
        assert run_command(["export", str(tmp_path / "s.gss"), "--format", "live", "--out", f"{bucket.address}/l"]) == 0
        files = bucket.files("l/")
        (part,) = [name for name in files if name.startswith("l/parts/")]
        assert files[part] == HEADER + b"".join(packet.data for packet in packets[:4])
        said = {
            name: bucket.client.head_object(Bucket=bucket.name, Key=name)["CacheControl"]
            for name in (part, "l/stream.json")
        }
        assert said == {part: live.FOR_EVER, "l/stream.json": live.FOR_A_SECOND}


def test_a_page_goes_to_a_store_with_the_headers_of_the_how_to(
    packets, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with StreamWriter.open(tmp_path / "s.gss") as writer:
        for packet in packets:
            writer.append(packet)
    package(tmp_path / "s.gss", tmp_path / "page")
    here = {path.relative_to(tmp_path / "page").as_posix(): path for path in (tmp_path / "page").rglob("*")}
    with stores.bucket("page", tmp_path / "cache") as bucket:
        to = f"{bucket.address}/p"
        assert run_command(["export", str(tmp_path / "s.gss"), "--format", "page", "--out", to]) == 0
        files = {name.removeprefix("p/"): data for name, data in bucket.files().items()}
        assert files == {name: path.read_bytes() for name, path in here.items() if path.is_file()}
        said = rules() | {"stream.json": "public, max-age=5"}
        for name in files:
            head = bucket.client.head_object(Bucket=bucket.name, Key=f"p/{name}")
            assert head["CacheControl"] == next(kept for rule, kept in said.items() if fnmatch.fnmatch(name, rule))
        capsys.readouterr()
        assert run_command(["export", str(tmp_path / "s.gss"), "--format", "ply", "--out", to]) == 2
        assert "only --format page and live go to an address" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("longest", "jump", "first"), [(relay.LONGEST, False, 0), (0, False, 8), (relay.LONGEST, True, 8)]
)
def test_a_relay_keeps_a_stream_that_begins_with_a_key_packet(
    packets, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, longest: int, jump: bool, first: int
) -> None:
    """Also where the server above went on at a key packet; some of these packets are as long as the file's header."""
    monkeypatch.setattr(relay, "LONGEST", longest)
    made = relay.Relay("ws://127.0.0.1:9/live", tmp_path / "s.gss", print)
    follower = Follower(tmp_path / "s.gss")
    cursor, got = Cursor(follower), list[bytes]()
    sent = [packet.data for packet in packets if not (jump and 4 <= packet.frame < 8)]
    assert min(len(packet.data) for packet in packets) == len(HEADER)
    made._take(HEADER)
    for data in sent:
        made._take(data)
        follower.look()
        while (entry := cursor.next()) is not None:
            got.append(follower.read(entry))
    assert got == sent
    with pytest.raises(PacketError, match="frame 5 came without the one before it"):
        made._take(packets[5].data)
    made._end()
    follower.look()
    assert follower.state().name == "ended"
    assert follower.entries[0].frame == first
    follower.close()


def test_a_relay_hands_on_every_packet_and_comes_back(packets, tmp_path: Path) -> None:
    growing = Growing(tmp_path / "s.gss")
    growing.write(packets[:4])
    with served(tmp_path / "s.gss", "--live") as (above, _):
        upstream = f"ws{above[4:]}live"
        with served(upstream, "--live") as (below, _):
            with live_socket(below) as socket:
                got, _ = packets_from(socket, until=3, seconds=60)
                growing.write(packets[4:])
                packets_from(socket, until=len(packets) - 1, seconds=60, into=got)
            assert_playable(got)
            assert [data for data in got if data != HEADER] == [packet.data for packet in packets]
            growing.file.close()
            StreamWriter.open(tmp_path / "s.gss", resume=True).close()
            with live_socket(below) as socket:
                late, _ = packets_from(socket, seconds=60)
    key = max(place for place, packet in enumerate(packets) if packet.kind == PacketKind.KEY)
    assert late[1:] == [packet.data for packet in packets[key:]]
