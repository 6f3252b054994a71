"""Stream files: what is written is what is read, however the writer ended."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from packet_scenes import decode_all, make_delta, make_key, make_packets, same_bits, write_stream

from gsstream.core.changes import Scene, apply_delta
from gsstream.core.errors import InputError, OutputError, PacketError, SourceError
from gsstream.packet import (
    StreamReader,
    StreamWriter,
    encode_delta,
    encode_empty,
    encode_key,
    next_decoders,
    quantise_key,
)
from gsstream.packet.base import FILE_HEADER, file_header
from gsstream.packet.reader import key_offsets, parse_index
from gsstream.player.playback import Playback


def test_reported_bytes_are_the_bytes_on_disk(tmp_path):
    packets = make_packets()
    path = tmp_path / "s.gss"
    writer = StreamWriter.open(path)
    expected = FILE_HEADER.size
    for packet in packets:
        expected += writer.append(packet)
        assert path.stat().st_size == expected  # flushed before append returns
    writer.close(index=False)
    assert path.stat().st_size == FILE_HEADER.size + sum(sum(p.sizes.values()) for p in packets)


def test_playback_equals_the_encoder_in_any_order(tmp_path):
    packets = make_packets()
    write_stream(tmp_path / "s.gss", packets)
    states = decode_all(packets)
    with Playback(tmp_path / "s.gss") as playback:
        assert list(playback.frames) == list(range(7))
        for frame in (6, 0, 3, 3, 1, 5, 2, 4, 6, 0):
            assert same_bits(playback.state_at(frame), states[frame].gaussians)
        assert [frame for frame, _ in playback] == list(range(7))
        with pytest.raises(InputError, match="frame 7"):
            playback.state_at(7)


def test_three_hundred_frames_without_drift(tmp_path):
    """The encoder adds up its own symbols, the player what it reads: equal bits, not tolerances, after every frame."""
    rng = np.random.default_rng(12)
    key = make_key(rng, 120, 30)
    scene, decoders, expected = Scene(quantise_key(key.gaussians), key.layout), {}, []
    with StreamWriter.open(tmp_path / "s.gss") as writer:
        writer.append(encode_key(key))
        expected.append(scene.gaussians)
        for frame in range(1, 300):
            delta = make_delta(rng, key.layout, share=0.1, latent=frame % 7 == 0)
            packet = encode_delta(delta, key.layout, decoders, frame=frame)
            decoders = next_decoders(decoders, delta)
            scene = apply_delta(scene, delta)
            writer.append(packet)
            expected.append(scene.gaussians)
    with Playback(tmp_path / "s.gss") as playback:
        for frame, shown in playback:
            assert same_bits(shown, expected[frame])
        assert same_bits(playback.state_at(150), expected[150])
    assert np.abs(expected[-1].means - expected[0].means).max() > 0.05


def test_stepping_forward_decodes_each_packet_once(tmp_path, monkeypatch):
    write_stream(tmp_path / "s.gss", make_packets())
    with Playback(tmp_path / "s.gss") as playback:
        read = []
        real = playback.reader.read
        monkeypatch.setattr(playback.reader, "read", lambda entry: (read.append(entry.frame), real(entry))[1])
        for frame in range(7):
            playback.state_at(frame)
        assert read == list(range(1, 7))


def test_index_is_found_from_the_end_and_names_the_keys(tmp_path):
    data = write_stream(tmp_path / "s.gss", make_packets())
    offset, magic = struct.unpack("<Q4s", data[-12:])
    assert magic == b"GSSX"
    with StreamReader(tmp_path / "s.gss") as reader:
        assert parse_index(data[offset:], offset) == key_offsets(reader.entries) != []
        reader.check()


def test_an_index_that_lies_is_found_out(tmp_path):
    packets = make_packets()
    write_stream(tmp_path / "a.gss", packets, index=False)
    other = write_stream(tmp_path / "b.gss", make_packets(seed=5), index=True)
    index = StreamReader(tmp_path / "b.gss").entries[-1]
    with (tmp_path / "a.gss").open("ab") as file:
        file.write(other[index.offset :])
    with StreamReader(tmp_path / "a.gss") as reader, pytest.raises(PacketError, match="index"):
        reader.check()


@pytest.mark.parametrize("index", [True, False])
def test_resume_gives_the_file_of_an_uninterrupted_run(tmp_path, index):
    packets = make_packets()
    whole = write_stream(tmp_path / "whole.gss", packets)
    path = tmp_path / "s.gss"
    write_stream(path, packets[:3], index=index)
    with StreamWriter.open(path, resume=True) as writer:
        assert writer.next_frame == 3
        for packet in packets[3:]:
            writer.append(packet)
    assert path.read_bytes() == whole


def test_resume_after_death_at_every_byte_of_a_packet(tmp_path):
    packets = make_packets()
    whole = write_stream(tmp_path / "whole.gss", packets)
    with StreamReader(tmp_path / "whole.gss") as reader:
        third = reader.entries[3]
    path = tmp_path / "s.gss"
    for cut in range(third.offset, third.offset + third.size):
        path.write_bytes(whole[:cut])
        with StreamWriter.open(path, resume=True) as writer:
            assert writer.next_frame == 3
            for packet in packets[3:]:
                writer.append(packet)
        assert path.read_bytes() == whole


def test_resume_never_cuts_good_packets_behind_damage(tmp_path):
    packets, path = make_packets(), tmp_path / "s.gss"
    data = bytearray(write_stream(path, packets))
    with StreamReader(path) as reader:
        second = reader.entries[1]
    for at, behind in ((9, b""), (60, b""), (5, bytes(1000))):  # its length; its body; with unwritten space behind all
        hurt = bytearray(data + behind)
        hurt[second.offset + at] ^= 1
        path.write_bytes(hurt)
        with pytest.raises(PacketError) as caught:
            StreamWriter.open(path, resume=True)
        assert caught.value.offset == second.offset
        assert path.read_bytes() == hurt


def test_resume_to_an_older_checkpoint(tmp_path):
    packets, path = make_packets(), tmp_path / "s.gss"
    whole = write_stream(path, packets)
    with StreamWriter.open(path, resume=True, last_frame=1) as writer:
        assert writer.next_frame == 2
        for packet in packets[2:]:
            writer.append(packet)
    assert path.read_bytes() == whole
    with pytest.raises(OutputError, match="frame 12"):
        StreamWriter.open(path, resume=True, last_frame=12)
    assert path.read_bytes() == whole


def test_writer_refuses_what_is_out_of_turn(tmp_path):
    packets, path = make_packets(), tmp_path / "s.gss"
    with StreamWriter.open(path) as writer:
        with pytest.raises(PacketError, match="key"):
            writer.append(packets[1])
        writer.append(packets[0])
        with pytest.raises(PacketError, match="consecutive"):
            writer.append(packets[2])
        with pytest.raises(PacketError, match="consecutive"):
            writer.append(encode_empty(frame=0))
    with pytest.raises(OutputError, match="exists"):
        StreamWriter.open(path)


def test_an_exception_leaves_a_valid_stream_without_index(tmp_path):
    packets, path = make_packets(), tmp_path / "s.gss"
    writer = StreamWriter.open(path)
    writer.append(packets[0])
    writer.__exit__(KeyboardInterrupt, KeyboardInterrupt(), None)
    assert path.stat().st_size == FILE_HEADER.size + len(packets[0].data)
    with Playback(path) as playback:
        assert len(playback) == 1


def test_a_growing_stream_can_be_followed(tmp_path):
    packets, path = make_packets(), tmp_path / "s.gss"
    writer = StreamWriter.open(path)
    writer.append(packets[0])
    with Playback(path) as playback:
        for number, packet in enumerate(packets[1:], 2):
            writer.append(packet)
            playback.refresh()
            assert len(playback) == number
        writer.close()
        playback.refresh()
        assert same_bits(playback.state_at(6), decode_all(packets)[6].gaussians)
        StreamWriter.open(path, resume=True).append(encode_empty(frame=7))
        playback.refresh()
        assert playback.frames[-1] == 7


def test_missing_and_empty_files_are_named(tmp_path):
    with pytest.raises(SourceError, match=r"nothing\.gss"):
        Playback(tmp_path / "nothing.gss")
    (tmp_path / "header.gss").write_bytes(file_header())
    with pytest.raises(PacketError, match="no complete packet"):
        Playback(tmp_path / "header.gss")
