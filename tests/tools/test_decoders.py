"""Four decoders side by side: equal on streams of every kind of change, and a decoder that differs is named."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tools import decoders
from tools.decoder_in_c import Library, compiler, play

pytestmark = [
    pytest.mark.skipif(compiler() is None, reason="there is no C compiler"),
    pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed (apt install nodejs)"),
]
PLAYED = Path(__file__).parents[1] / "conformance" / "play"


@pytest.fixture
def stream(tmp_path: Path) -> Path:
    path = tmp_path / "some" / "stream.gss"
    path.parent.mkdir()
    path.write_bytes(decoders.large_stream(400, 40, 4, leave=3))
    return path


def test_decoders_agree_and_whoever_does_not_is_named(
    stream: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = [stream, PLAYED / "motion-eight-at-once.gss", PLAYED / "field-marked.gss", PLAYED / "layers-degree-3.gss"]
    lines = decoders.agree(paths, tmp_path)
    assert [line.rpartition(": ")[2] for line in lines] == ["equal"] * 4
    assert "4 frames, Python, JavaScript, C" in lines[0]
    monkeypatch.setattr(decoders, "play", lambda library, data: (play(library, data)[0][:-1], None))
    assert decoders.agree(paths[:1], tmp_path)[0].endswith("other frames from C")


def test_times_are_of_every_packet_and_decoder(stream: Path, tmp_path: Path) -> None:
    key, delta = decoders.measured(stream, tmp_path, 1)
    assert (key["packets"], delta["packets"], delta["Gaussians"]) == (1, 3, 400)
    assert all(value > 0 for row in (key, delta) for name, value in row.items() if name.endswith("_ms"))
    assert {"python_ms", "javascript_ms", "c_ms"} <= set(key)


def test_the_decoder_in_c_says_what_it_refuses(tmp_path: Path) -> None:
    library = Library(tmp_path)
    sound = (PLAYED / "key-degree-3.gss").read_bytes()
    digests, fault = play(library, sound[:-1] + bytes([sound[-1] ^ 1]))
    assert digests == []
    assert fault is not None
    assert (fault.rule, fault.byte) == ("R-1.2-4", 16)
    _, fault = play(library, sound, limit=10)
    assert fault is not None
    assert "memory" in fault.message
