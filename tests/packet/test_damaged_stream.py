"""A damaged stream is played up to the damage and then reported: no command stops early and says nothing."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import pytest
from test_player import make_stream

from gsstream.cli.main import run_command
from gsstream.core.errors import PacketError
from gsstream.packet import StreamReader
from gsstream.packet.base import PACKET_HEADER
from gsstream.player.export import export
from gsstream.player.play import play
from gsstream.player.playback import Playback, TruncatedStreamWarning

BAD = 3


@pytest.fixture(params=["header", "body", "junk"])
def damaged(request, tmp_path) -> Path:
    """Five frames; frame 3 cannot be read: a flipped bit of its header or body, or junk before it."""
    path = make_stream(tmp_path / "s.gss")
    data = bytearray(path.read_bytes())
    with StreamReader(path) as reader:
        at = reader.frames[BAD].offset
    if request.param == "junk":
        data[at:] = b"\x07 these bytes are no packet, whoever wrote them"
    else:
        data[at + (4 if request.param == "header" else PACKET_HEADER.size + 9)] ^= 1
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("command", [["play"], ["export"], ["export", "--format", "sequence"]], ids=" ".join)
def test_commands_do_what_is_sound_and_fail_with_the_offset(command, damaged, tmp_path, capsys) -> None:
    assert run_command([command[0], str(damaged), "--out", str(tmp_path / "out"), *command[1:]]) == 1
    assert "(at byte " in capsys.readouterr().err
    written = sorted(path.stem for path in (tmp_path / "out").iterdir() if path.suffix != ".json")
    assert written == [f"{frame:06d}" for frame in range(BAD)]
    if "sequence" in command:
        listed = json.loads((tmp_path / "out" / "sequence.json").read_text())["frames"]
        assert [entry["frame"] for entry in listed] == list(range(BAD))


@pytest.mark.parametrize("name", ["x.gif", "x.webp", "x.mp4"])
def test_an_animation_holds_what_is_sound(name, damaged, tmp_path) -> None:
    if name.endswith("mp4"):
        pytest.importorskip("av")
    assert run_command(["play", str(damaged), "--out", str(tmp_path / name)]) == 1
    assert (tmp_path / name).stat().st_size > 500


def test_python_callers_get_the_damage_too(damaged, tmp_path) -> None:
    with pytest.raises(PacketError, match="at byte"):
        play(damaged, tmp_path / "p")
    with pytest.raises(PacketError, match="at byte"):
        export(damaged, tmp_path / "e", "ply")
    assert len(list((tmp_path / "p").iterdir())) == len(list((tmp_path / "e").iterdir())) == BAD


@pytest.mark.parametrize(("frames", "code", "count"), [("0:3", 0, 3), ("1:2", 0, 1), ("0:5", 1, 3), ("2:", 1, 1)])
def test_only_damage_in_the_frames_asked_for_counts(frames, code, count, damaged, tmp_path) -> None:
    assert run_command(["play", str(damaged), "--out", str(tmp_path / "p"), "--frames", frames]) == code
    assert len(list((tmp_path / "p").iterdir())) == count


def test_frames_behind_the_damage_are_refused(damaged, tmp_path, capsys) -> None:
    assert run_command(["play", str(damaged), "--out", str(tmp_path / "p"), "--frames", "4:5"]) == 1
    assert "at byte" in capsys.readouterr().err
    assert not (tmp_path / "p").exists()


def test_evaluate_measures_what_is_sound_and_fails(tmp_path, capsys) -> None:
    """On a real run, because evaluate needs its recording."""
    out = tmp_path / "run"
    arguments = ["run", "--source", "demo", "--method", "hold", "--scale", "0.25", "--frames", "4", "--no-pictures"]
    quick = ["--set", "first_frame.max_iterations=5"]
    assert run_command([*arguments, "--out", str(out), "--quiet", *quick]) == 0
    capsys.readouterr()
    assert run_command(["evaluate", str(out), "--json", "--max-memory", "100MB"]) == 0
    views = json.loads(capsys.readouterr().out)["views"]
    assert [view["frame"] for view in views] == [0, 1, 2, 3]
    assert all(5 < view["psnr"] < 60 for view in views)
    assert run_command(["evaluate", str(out), "--max-memory", "100KB"]) == 2
    assert "the limit is 0.1 MB" in capsys.readouterr().err
    stream = out / "stream.gss"
    with StreamReader(stream) as reader:
        at = reader.frames[2].offset
    data = bytearray(stream.read_bytes())
    data[at + 5] ^= 4
    stream.write_bytes(data)
    assert run_command(["evaluate", str(out)]) == 1
    said = capsys.readouterr()
    assert "decoded" in said.out
    assert f"(at byte {at})" in said.err


def test_an_unfinished_tail_is_a_warning_and_no_error(tmp_path, capsys) -> None:
    path = make_stream(tmp_path / "s.gss")
    with StreamReader(path) as reader:
        at = reader.frames[4].offset
    path.write_bytes(path.read_bytes()[: at + 20])
    assert run_command(["play", str(path), "--out", str(tmp_path / "p")]) == 0
    assert f"20 bytes from byte {at}" in capsys.readouterr().err
    assert len(list((tmp_path / "p").iterdir())) == 4
    with warnings.catch_warnings(), Playback(path) as playback:
        warnings.simplefilter("error", TruncatedStreamWarning)
        assert playback.sound(0, 3) == (range(3), None)
        with pytest.raises(TruncatedStreamWarning):
            playback.sound()
