"""Streams of every format version ever released decode to the bits they always decoded to."""

from __future__ import annotations

import json
import struct
import zlib

import pytest
from make_samples import SAMPLES, digest
from packet_scenes import make_packets, write_stream

from gsstream.core.errors import PacketError
from gsstream.packet import FORMAT_VERSION, StreamReader, base, decode_delta, decode_empty, decode_key
from gsstream.player.playback import Playback

VERSIONS = sorted(folder.name for folder in SAMPLES.iterdir() if folder.is_dir())


def test_the_current_version_has_samples():
    assert FORMAT_VERSION in VERSIONS


@pytest.mark.parametrize("version", VERSIONS)
def test_stored_streams_decode(version):
    folder = SAMPLES / version
    with Playback(folder / "stream.gss") as playback:
        assert [digest(scene) for _, scene in playback] == json.loads((folder / "expected.json").read_text())
        playback.reader.check()
        assert playback.meta.camera("held-out").near == 0.02


@pytest.mark.parametrize("version", VERSIONS)
def test_stored_packets_decode(version):
    folder = SAMPLES / version
    key = decode_key((folder / "key.bin").read_bytes())
    assert digest(key.gaussians) == json.loads((folder / "expected.json").read_text())[0]
    delta = decode_delta((folder / "delta.bin").read_bytes(), key.layout, {})
    assert set(delta.symbols) == {"means", "quats", "opacities", "sh0"}
    assert set(delta.decoders) == {"sh0"}
    decode_empty((folder / "empty.bin").read_bytes())


def _with_version(path, data, major, minor):
    head = struct.pack("<8sHH", base.MAGIC, major, minor)
    path.write_bytes(head + struct.pack("<I", zlib.crc32(head)) + data[16:])
    return path


def test_other_versions_are_refused_with_the_reason(tmp_path):
    data = (SAMPLES / FORMAT_VERSION / "stream.gss").read_bytes()
    with pytest.raises(PacketError, match=r"this gsstream reads 1\.x"):
        StreamReader(_with_version(tmp_path / "a.gss", data, base.FORMAT_MAJOR + 1, 0))
    with pytest.raises(PacketError, match="upgrade gsstream"):
        StreamReader(_with_version(tmp_path / "b.gss", data, base.FORMAT_MAJOR, base.FORMAT_MINOR + 1))


def test_an_older_minor_version_is_fine(monkeypatch):
    monkeypatch.setattr(base, "FORMAT_MINOR", base.FORMAT_MINOR + 1)
    with Playback(SAMPLES / FORMAT_VERSION / "stream.gss") as playback:
        assert len(playback) == 7


def test_writing_is_deterministic(tmp_path):
    packets = make_packets(seed=1)
    assert write_stream(tmp_path / "a.gss", packets) == write_stream(tmp_path / "b.gss", make_packets(seed=1))
