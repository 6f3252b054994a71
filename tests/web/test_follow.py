"""Following a stream file: half packets, files begun again, and what viewers get whatever they and the file do."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from moving_scenes import moving_packets

from gsstream.core.errors import PacketError
from gsstream.engine.run.output import LOCK
from gsstream.packet import PacketKind, StreamReader, StreamWriter
from gsstream.packet.base import build_packet, file_header
from gsstream.serve.cursor import Cursor
from gsstream.serve.follow import Follower, writer_is_gone


def read_all(follower: Follower) -> list[bytes]:
    return [follower.read(entry) for entry in follower.entries[: follower.count]]


@pytest.fixture(scope="module")
def packets():
    return moving_packets(seed=5, frames=9, number=20, nodes=6, sh_rest=0, key_at=4)


def test_a_packet_is_there_when_its_last_byte_is(tmp_path, packets):
    path = tmp_path / "s.gss"
    follower = Follower(path)
    assert not follower.look()
    data, ends = file_header(), {}
    for packet in packets:
        data += packet.data
        ends[len(data)] = packet.frame
    seen = []
    with path.open("wb", buffering=0) as file:
        for at in range(len(data)):
            file.write(data[at : at + 1])
            follower.look()
            if follower.newest is not None and follower.newest not in seen:
                seen.append(follower.newest)
                assert ends[at + 1] == follower.newest
            assert follower.state().name in ("waiting", "live")
    assert seen == [packet.frame for packet in packets]
    assert read_all(follower) == [packet.data for packet in packets]
    assert sorted(follower.written) == seen
    assert follower.generation == 1


def test_the_index_ends_a_stream_and_resuming_goes_on(tmp_path, packets):
    path = tmp_path / "s.gss"
    follower = Follower(path)
    with StreamWriter.open(path) as writer:
        for packet in packets[:3]:
            writer.append(packet)
    follower.look()
    assert (follower.state().name, follower.newest) == ("ended", 2)
    with StreamWriter.open(path, resume=True) as writer:
        follower.look()
        assert follower.state().name == "live"
        writer.append(packets[3])
        follower.look()
        assert (follower.newest, follower.generation) == (3, 1)


@pytest.mark.parametrize("how", ["replaced", "cut and written anew", "removed first"])
def test_another_stream_in_its_place_is_another_generation(tmp_path, packets, how):
    path = tmp_path / "s.gss"
    path.write_bytes(file_header() + b"".join(packet.data for packet in packets))
    follower = Follower(path)
    follower.look()
    cursor = Cursor(follower)
    while cursor.next():
        pass
    others = moving_packets(seed=6, frames=9, number=20, nodes=6, sh_rest=0, key_at=20)
    data = file_header() + b"".join(packet.data for packet in others)
    if how == "replaced":
        (tmp_path / "new").write_bytes(data)
        (tmp_path / "new").replace(path)
    elif how == "removed first":
        path.unlink()
        follower.look()
        assert follower.state().name == "waiting"
        assert cursor.next() is None
        path.write_bytes(data)
    else:
        with path.open("r+b") as file:
            file.truncate(len(file_header()))
            file.seek(0)
            file.write(data)
    follower.look()
    assert follower.generation == 2
    assert read_all(follower) == [packet.data for packet in others]
    assert cursor.next().kind == PacketKind.KEY


@pytest.mark.parametrize("content", [b"", b"\x89GS", b"<!doctype html>..", b"x" * 100])
def test_what_is_no_stream_is_waited_for_or_told(tmp_path, content):
    path = tmp_path / "s.gss"
    path.write_bytes(content)
    follower = Follower(path)
    follower.look()
    assert follower.state().name == ("damaged" if len(content) >= 16 else "waiting")
    assert Cursor(follower).next() is None


def test_a_writer_that_was_killed_is_known_by_its_lock(tmp_path):
    with subprocess.Popen([sys.executable, "-c", "pass"]) as ended:
        ended.wait()
    assert not writer_is_gone(tmp_path), "nobody can tell"
    (tmp_path / "recipe.yaml").touch()
    assert writer_is_gone(tmp_path), "a run's folder, and no run holds it"
    host = socket.gethostname()
    for pid, name, gone in [(os.getpid(), host, False), (ended.pid, host, True), (ended.pid, "elsewhere", False)]:
        (tmp_path / LOCK).write_text(json.dumps({"pid": pid, "host": name, "since": ""}))
        assert writer_is_gone(tmp_path) is gone
    (tmp_path / LOCK).write_text("")
    assert not writer_is_gone(tmp_path), "it is being written"


def tiny(frame: int, key: bool) -> bytes:
    """A packet as far as a server looks at it: header and checksum are right."""
    kind = PacketKind.KEY if key else PacketKind.DELTA
    return build_packet(kind, frame, [("meta" if key else "gates", bytes([frame % 251]))]).data


#: The file grows (by a key packet or not), is begun again, or gets a damaged packet; the viewer takes a packet.
EVENT = st.sampled_from(["key", *["delta"] * 3, *["take"] * 3, "new", "damage"])


@settings(max_examples=60, deadline=None)
@given(events=st.lists(EVENT, max_size=80), max_lag=st.integers(1, 5))
def test_no_viewer_ever_gets_a_delta_alone(tmp_path_factory, events, max_lag):
    path = tmp_path_factory.mktemp("s") / "s.gss"
    follower = Follower(path)
    cursor = Cursor(follower, max_lag=max_lag)
    held, frame, restart = None, 0, True

    def take() -> bool:
        nonlocal held
        entry = cursor.next()
        if entry is None:
            return False
        try:
            data = follower.read(entry)
        except PacketError:
            cursor.refuse()
            held = None
            return True
        if entry.kind != PacketKind.KEY:
            assert held == (cursor.generation, entry.frame - 1)
        held = cursor.generation, int.from_bytes(data[4:8], "little")
        return True

    for event in [*events, "key"]:
        if event == "take":
            take()
            continue
        if event == "new" or restart:
            path.unlink(missing_ok=True)
            path.write_bytes(file_header())
            frame, restart = 0, False
        with path.open("r+b") as file:
            size = file.seek(0, 2)
            file.write(tiny(frame, key=event == "key" or frame == 0))
            if event == "damage":
                file.seek(size + 20)
                file.write(b"\xff\xff")
        frame += 1
        os.utime(path, ns=(0, size + frame))
        follower.look()
    # The last packet is a sound key packet: everybody arrives there, however late or damaged before.
    while take():
        pass
    with StreamReader(path) as reader:
        assert held == (follower.generation, reader.frames[-1].frame)
    assert cursor.at_end
