"""Damaged and malicious streams: a correct prefix or a PacketError with its byte, never a crash or large allocation."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest
from packet_scenes import decode_all, make_packets, same_bits, write_stream

from gsstream.core.errors import PacketError
from gsstream.packet import (
    StreamReader,
    encode_empty,
)
from gsstream.packet.base import MAX_BODY, file_header
from gsstream.player.playback import Playback


@pytest.fixture(scope="module")
def small():
    packets = make_packets(frames=5, key_at=3, number=8, nodes=4, sh_rest=0)
    return packets, decode_all(packets)


def play_prefix(path, states):
    """Play until the end or an error; every frame seen must be right. Returns (frames seen, error or None)."""
    seen, error = 0, None
    try:
        with Playback(path) as playback:
            for frame, scene in playback:
                assert frame == seen
                assert same_bits(scene, states[frame].gaussians)
                seen += 1
    except PacketError as caught:
        error = caught
    assert error is None or 0 <= error.offset <= path.stat().st_size
    return seen, error


def test_truncation_at_every_byte_keeps_every_complete_packet(tmp_path, small):
    packets, states = small
    data = write_stream(tmp_path / "whole.gss", packets)
    ends = np.cumsum([16] + [len(p.data) for p in packets])[1:]
    path = tmp_path / "cut.gss"
    for cut in range(len(data)):
        path.write_bytes(data[:cut])
        complete = int((ends <= cut).sum())
        if cut >= 16:
            with StreamReader(path) as reader:
                assert len(reader.frames) == complete
                assert reader.damage is None
                assert (reader.unfinished is None) == (cut in {16, *ends.tolist(), len(data)})
        if cut % 17 == 0 or cut in ends:
            seen, error = play_prefix(path, states)
            assert seen == complete
            assert (error is None) == (complete > 0)


def test_every_flipped_bit_is_noticed_at_or_before_its_packet(tmp_path, small):
    packets, states = small
    data = write_stream(tmp_path / "whole.gss", packets, index=False)
    ends = np.cumsum([16] + [len(p.data) for p in packets])[1:]
    rng, path = np.random.default_rng(0), tmp_path / "flipped.gss"
    for at in range(len(data)):
        hurt = bytearray(data)
        hurt[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(hurt)
        sound = int((ends <= at).sum())
        if at >= 16:
            with StreamReader(path) as reader:
                with pytest.raises(PacketError) as caught:
                    reader.check()
                assert caught.value.offset == (ends[sound - 1] if sound else 16)
        if at % 17 == 0:
            seen, error = play_prefix(path, states)
            assert error is not None
            assert seen == sound


def test_flips_in_the_index_are_found_by_check(tmp_path, small):
    packets, _ = small
    data = write_stream(tmp_path / "whole.gss", packets)
    start = len(write_stream(tmp_path / "bare.gss", packets, index=False))
    for at in range(start, len(data)):
        hurt = bytearray(data)
        hurt[at] ^= 0x10
        (tmp_path / "x.gss").write_bytes(hurt)
        with StreamReader(tmp_path / "x.gss") as reader:
            assert len(reader.frames) == 5
            with pytest.raises(PacketError):
                reader.check()


def test_random_bytes_are_no_stream(tmp_path):
    rng, path = np.random.default_rng(1), tmp_path / "random.gss"
    for size in [0, 1, 15, 16, 17, 64, 1000] * 10:
        path.write_bytes(rng.bytes(size))
        with pytest.raises(PacketError) as caught:
            Playback(path)
        assert caught.value.offset is not None
        path.write_bytes(file_header() + rng.bytes(size))
        with pytest.raises(PacketError):
            Playback(path)


def _header(kind, sections, frame, body, data=b""):
    checksum = zlib.crc32(data, zlib.crc32(struct.pack("<BBII", kind, sections, frame, body)))
    check = zlib.crc32(struct.pack("<BBIII", kind, sections, frame, body, checksum)) & 0xFFFF
    return struct.pack("<BBHIII", kind, sections, check, frame, body, checksum) + data


@pytest.mark.parametrize(
    "packet",
    [
        _header(9, 0, 1, 0),
        _header(2, 255, 1, 4000),
        _header(2, 0, 1, MAX_BODY + 1),
        _header(2, 3, 1, 2, b"ab"),
        _header(2, 1, 1, 5, struct.pack("<BI", 99, 0)),
        _header(2, 1, 1, 5, struct.pack("<BI", 3, 0xFFFFFFFF)),
        _header(2, 2, 1, 10, struct.pack("<BIBI", 3, 0, 3, 0)),
        _header(2, 1, 1, 6, struct.pack("<BI", 3, 0) + b"x"),
        _header(3, 1, 1, 5, struct.pack("<BI", 3, 0)),
        _header(3, 0, 5, 0),
        _header(2, 0, 1, 0),
    ],
)
def test_impossible_headers_stop_the_walk_at_their_byte(tmp_path, small, packet):
    packets, states = small
    path = tmp_path / "s.gss"
    start = len(write_stream(path, packets[:1], index=False))
    with path.open("ab") as file:
        file.write(packet)
    seen, error = play_prefix(path, states)
    assert seen == 1
    assert start <= error.offset <= start + len(packet)


def test_a_length_beyond_the_file_is_an_unfinished_packet(tmp_path, small):
    packets, _ = small
    path = tmp_path / "s.gss"
    start = len(write_stream(path, packets[:1], index=False))
    with path.open("ab") as file:
        file.write(_header(2, 1, 1, MAX_BODY))
    with StreamReader(path) as reader:
        assert reader.damage is None
        assert (reader.unfinished.offset, reader.unfinished.size) == (start, 16)


def test_a_stream_must_begin_with_a_key_packet(tmp_path):
    path = tmp_path / "s.gss"
    path.write_bytes(file_header() + encode_empty(frame=0).data)
    with pytest.raises(PacketError, match="key packet first") as caught:
        Playback(path)
    assert caught.value.offset == 16


def test_damage_behind_the_frame_asked_for_does_not_matter(tmp_path, small):
    packets, states = small
    data = bytearray(write_stream(tmp_path / "s.gss", packets))
    with StreamReader(tmp_path / "s.gss") as reader:
        hurt = reader.entries[2]
    data[hurt.offset + 8] ^= 1
    (tmp_path / "s.gss").write_bytes(data)
    with Playback(tmp_path / "s.gss") as playback:
        assert same_bits(playback.state_at(1), states[1].gaussians)
        with pytest.raises(PacketError) as caught:
            playback.state_at(2)
        assert caught.value.offset == hurt.offset
