"""A client with a manifest and byte ranges, against a real web server on loopback, reaches the encoder's frames."""

from __future__ import annotations

import http.server
import itertools
import json
import threading
import urllib.request
from pathlib import Path

import pytest

from gsstream.core.errors import PacketError
from gsstream.packet import PacketKind, PlayerState, decode_packet
from gsstream.player.manifest import manifest, manifest_json
from gsstream.player.playback import Playback


class RangeHandler(http.server.SimpleHTTPRequestHandler):
    """What any static web server does: whole files, and single byte ranges as 206."""

    def do_GET(self) -> None:
        data = Path(self.translate_path(self.path)).read_bytes()
        wanted = self.headers.get("Range")
        if wanted is None:
            self.send_response(200)
        else:
            first, last = (int(number) for number in wanted.removeprefix("bytes=").split("-"))
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {first}-{last}/{len(data)}")
            data = data[first : last + 1]
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, *_args: object) -> None:
        pass


@pytest.fixture
def served(tmp_path, stream_bytes):
    """A folder with a stream of two key packets and its manifest, and the address it is served at."""
    (tmp_path / "s.gss").write_bytes(stream_bytes)
    (tmp_path / "s.json").write_text(manifest_json(tmp_path / "s.gss"))
    server = http.server.ThreadingHTTPServer(
        ("127.0.0.1", 0), lambda *args: RangeHandler(*args, directory=str(tmp_path))
    )
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield tmp_path, f"http://127.0.0.1:{server.server_address[1]}"
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture(scope="module")
def stream_bytes(tmp_path_factory):
    """Two recordings of a key packet and four deltas each, one after the other."""
    from test_player import make_stream

    from gsstream.packet import EncodedPacket, StreamReader, StreamWriter
    from gsstream.packet.base import build_packet, parse_packet

    folder = tmp_path_factory.mktemp("streams")
    with StreamReader(make_stream(folder / "one.gss")) as reader:
        packets = [data for entry, data in reader if entry.kind != PacketKind.INDEX]
    with StreamWriter.open(folder / "two.gss") as writer:
        for frame, data in enumerate(packets + packets):
            header, sections = parse_packet(data)
            packet = build_packet(header.kind, frame, [(name, s.data) for name, s in sections.items()])
            writer.append(EncodedPacket(packet.data, packet.sizes))
    return (folder / "two.gss").read_bytes()


def fetch(url: str, piece: list[int] | None = None) -> bytes:
    headers = {} if piece is None else {"Range": f"bytes={piece[0]}-{piece[1]}"}
    with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=10) as answer:
        assert answer.status == (200 if piece is None else 206)
        return answer.read()


def test_a_client_joins_late_by_byte_ranges(served):
    folder, address = served
    contents = json.loads(fetch(f"{address}/s.json"))
    late = contents["segments"][1]
    assert late["frames"] == [5, 9]
    url = f"{address}/{contents['file']}"
    (folder / "late.gss").write_bytes(fetch(url, contents["header"]) + fetch(url, late["range"]))
    with Playback(folder / "s.gss") as whole, Playback(folder / "late.gss") as part:
        assert list(part.frames) == [5, 6, 7, 8, 9]
        for frame in part.frames:
            assert [a.tobytes() for _, a in part.state_at(frame).items()] == [
                a.tobytes() for _, a in whole.state_at(frame).items()
            ]


def test_single_packets_by_range_lead_to_the_same_state(served):
    folder, address = served
    contents = json.loads(fetch(f"{address}/s.json"))
    state: PlayerState | None = None
    with Playback(folder / "s.gss") as whole:
        for packet in contents["packets"]:
            state = decode_packet(state, fetch(f"{address}/s.gss", packet["range"]), offset=packet["range"][0])
            assert state.frame == packet["frame"]
            assert (packet["kind"] == "key") == (state.frame % 5 == 0)
            assert state.gaussians.means.tobytes() == whole.state_at(state.frame).means.tobytes()


def test_ranges_tile_the_stream(tmp_path, stream_bytes):
    (tmp_path / "s.gss").write_bytes(stream_bytes)
    contents = manifest(tmp_path / "s.gss")
    pieces = [contents["header"], *(packet["range"] for packet in contents["packets"])]
    for before, after in itertools.pairwise(pieces):
        assert after[0] == before[1] + 1
    segments = contents["segments"]
    assert segments[0]["range"][0] == 16
    assert segments[0]["range"][1] + 1 == segments[1]["range"][0]
    assert segments[1]["range"][1] == pieces[-1][1]
    assert pieces[-1][1] < len(stream_bytes) - 1  # the index follows


def test_no_manifest_of_a_damaged_stream(tmp_path, stream_bytes):
    hurt = bytearray(stream_bytes)
    hurt[5000] ^= 1
    (tmp_path / "s.gss").write_bytes(hurt)
    with pytest.raises(PacketError):
        manifest(tmp_path / "s.gss")
