"""Streams of every format version that this one reads decode to the bits they always decoded to."""

from __future__ import annotations

import json
import struct
import zlib

import pytest
from make_samples import SAMPLES, digest

from gsstream.core.changes import Scene
from gsstream.core.errors import OutputError, PacketError
from gsstream.packet import (
    FORMAT_VERSION,
    StreamReader,
    StreamWriter,
    base,
    decode_delta,
    decode_empty,
    decode_key,
    decode_packet,
)
from gsstream.player.playback import Playback

#: A stream that the first format version wrote; gsstream 2 does not read it.
OLD = SAMPLES / "1.1" / "stream.gss"
VERSIONS = sorted(file.parent.name for file in SAMPLES.glob("*/expected.json"))


def expected(version):
    return json.loads((SAMPLES / version / "expected.json").read_text())


def test_the_current_version_has_samples():
    assert FORMAT_VERSION in VERSIONS


@pytest.mark.parametrize(("version", "name"), [(v, name) for v in VERSIONS for name in expected(v)])
def test_stored_streams_decode(version, name):
    with Playback(SAMPLES / version / f"{name}.gss") as playback:
        assert [digest(scene) for _, scene in playback] == expected(version)[name]
        playback.reader.check()
        assert playback.meta.camera("held-out").near_plane == 0.02


@pytest.mark.parametrize("version", VERSIONS)
def test_stored_packets_decode(version):
    folder = SAMPLES / version
    key = decode_key((folder / "key.bin").read_bytes())
    assert digest(key.gaussians) == expected(version)["stream"][0]
    scene = Scene(key.gaussians, key.layout)
    residual = decode_delta((folder / "delta.bin").read_bytes(), scene, {}).residual
    assert set(residual.symbols) == {"means", "quats", "opacities", "sh0"}
    assert set(residual.decoders) == {"sh0"}
    decode_empty((folder / "empty.bin").read_bytes())


@pytest.mark.parametrize("version", VERSIONS)
def test_the_moving_sample_has_every_form_of_motion(version):
    """The sample would guard nothing that it does not contain."""
    state, said = None, []
    with StreamReader(SAMPLES / version / "moving.gss") as reader:
        for entry in reader.frames:
            state = decode_packet(state, reader.read(entry))
            motions = () if state.delta is None else state.delta.motions
            said += [(m.predicted, m.regroup, bool(m.symbols.any())) for m in motions if len(m.symbols)]
            said += [(len(motions), type(change).__name__) for change in (state.delta.changes if state.delta else ())]
    wanted = {
        (False, False, True),
        (True, False, False),
        (True, False, True),
        (True, True, True),
        (1, "Residual"),
        (1, "RowEdit"),
        (2, "Motion"),
    }
    assert wanted <= set(said)


def test_an_old_major_version_is_refused_in_one_sentence(tmp_path):
    wanted = r"packet format 1\.1 cannot be read: this gsstream reads 2\.x; play it with the gsstream that wrote it"
    for look in (StreamReader, Playback):
        with pytest.raises(PacketError, match=rf"^{wanted} \(at byte 8\)$"):
            look(OLD)
    path = tmp_path / "s.gss"
    path.write_bytes(OLD.read_bytes())
    with pytest.raises((PacketError, OutputError), match=wanted):
        StreamWriter.open(path, resume=True)
    assert path.read_bytes() == OLD.read_bytes()


def _with_version(path, data, major, minor):
    head = struct.pack("<8sHH", base.MAGIC, major, minor)
    path.write_bytes(head + struct.pack("<I", zlib.crc32(head)) + data[16:])
    return path


def test_other_versions_are_refused_with_the_reason(tmp_path):
    data = (SAMPLES / FORMAT_VERSION / "stream.gss").read_bytes()
    with pytest.raises(PacketError, match=rf"this gsstream reads {base.FORMAT_MAJOR}\.x"):
        StreamReader(_with_version(tmp_path / "a.gss", data, base.FORMAT_MAJOR + 1, 0))
    with pytest.raises(PacketError, match="upgrade gsstream"):
        StreamReader(_with_version(tmp_path / "b.gss", data, base.FORMAT_MAJOR, base.FORMAT_MINOR + 1))


def test_an_older_minor_version_is_fine(monkeypatch):
    monkeypatch.setattr(base, "FORMAT_MINOR", base.FORMAT_MINOR + 1)
    with Playback(SAMPLES / FORMAT_VERSION / "stream.gss") as playback:
        assert len(playback) == 7


def test_an_older_minor_version_is_not_continued(tmp_path, monkeypatch):
    path = tmp_path / "s.gss"
    data = (SAMPLES / FORMAT_VERSION / "stream.gss").read_bytes()
    path.write_bytes(data)
    monkeypatch.setattr(base, "FORMAT_MINOR", base.FORMAT_MINOR + 1)
    monkeypatch.setattr("gsstream.packet.writer.FORMAT_VERSION", f"{base.FORMAT_MAJOR}.{base.FORMAT_MINOR}")
    with pytest.raises(OutputError, match=rf"packet format {FORMAT_VERSION}"):
        StreamWriter.open(path, resume=True)
    assert path.read_bytes() == data
