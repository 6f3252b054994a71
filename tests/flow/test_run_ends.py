"""How runs end from outside: by a service, beside another run, on a disk that is full."""

from __future__ import annotations

import io
import os
import shutil
import signal
import time
from contextlib import redirect_stderr
from pathlib import Path

import pytest
from flow_runs import arguments, demo_copy, encode, metrics
from forked import Forked

from gsstream.cli.main import run_command
from gsstream.packet import StreamReader

LONG = "synthetic:frames=16&views=3&width=64&height=48&supersample=1"


def until(path: Path, size: int, process) -> None:
    deadline = time.monotonic() + 600
    while not (path.exists() and path.stat().st_size > size):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.mark.slow
def test_a_service_ends_a_run_politely_and_a_second_run_is_kept_out(tmp_path, capsys) -> None:
    out = tmp_path / "o"
    with Forked(arguments(out, source=LONG)) as process:
        until(out / "stream.gss", 3000, process)
        os.kill(process.pid, signal.SIGSTOP)  # it must not come to its end while the second run is tried
        recipe = (out / "recipe.yaml").read_bytes()
        assert run_command(arguments(out, "--overwrite", "--set", "seed=7", source=LONG)) == 2
        assert f"process {process.pid}" in capsys.readouterr().err
        assert (out / "recipe.yaml").read_bytes() == recipe, "the refused run has touched nothing"
        os.kill(process.pid, signal.SIGTERM)
        os.kill(process.pid, signal.SIGCONT)
        _, err = process.communicate(timeout=600)
    assert (process.returncode, err) == (143, "ended by SIGTERM\n")
    with StreamReader(out / "stream.gss") as reader:
        reader.check()
        done = len(reader.frames)
    assert 1 <= done < 16
    assert [line["frame"] for line in metrics(out)] == list(range(done))
    assert not (out / "run.lock").exists()
    assert encode(out, "--resume", source=LONG) == encode(tmp_path / "whole", source=LONG)


def test_a_folder_that_vanishes_is_one_sentence(tmp_path, capsys, monkeypatch) -> None:
    """The disk is emptied while frame 0 is made; what is written next says so."""
    from gsstream.engine.run import session

    real = session.save_resolved

    def save(path: Path, resolved: object) -> None:
        shutil.rmtree(path.parent)
        real(path, resolved)

    monkeypatch.setattr(session, "save_resolved", save)
    assert run_command(arguments(tmp_path / "o")) == 2
    err = capsys.readouterr().err
    assert "do not move or delete the folder of a run" in err
    assert "Traceback" not in err


@pytest.fixture(scope="module")
def broken(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, bytes]:
    """(recording of four frames, run of it, the picture that was spoilt): the last picture of one camera."""
    folder = demo_copy(tmp_path_factory.mktemp("broken") / "recording", frames=4)
    out, picture = folder.parent / "o", folder / "cam00" / "000003.jpg"
    sound = picture.read_bytes()
    picture.write_bytes(sound[:200])
    err = io.StringIO()
    with redirect_stderr(err):
        assert run_command(arguments(out, source=str(folder), scale=0.5, pictures=True)) == 2
    (folder.parent / "err.txt").write_text(err.getvalue())
    return folder, out, sound


def test_a_run_that_fails_at_its_last_frame_shows_the_others_and_how_to_go_on(broken) -> None:
    folder, out, _ = broken
    assert {"summary.txt", "contact_sheet.png", "frames.png", "stream.gss"} <= {path.name for path in out.iterdir()}
    assert "dense" in (out / "summary.txt").read_text()
    assert [line["frame"] for line in metrics(out)] == [0, 1, 2]
    first, note = (folder.parent / "err.txt").read_text().strip().splitlines()[-2:]
    assert first.startswith("error: ")
    assert "000003.jpg" in first
    assert "complete up to frame 2, and its summary and pictures are made" in note
    assert "--resume" in note
    assert "data.bad_image=repeat" in note


def test_the_advice_can_be_followed(broken, tmp_path, capsys) -> None:
    """The same command with --resume and the policy goes on; so does the command alone, when the picture is mended."""
    folder, out, sound = broken
    other = Path(shutil.copytree(out, tmp_path / "o"))
    assert run_command(arguments(other, "--resume", source=str(folder), scale=0.5)) == 2
    assert "its summary is made" in capsys.readouterr().err
    passing = ("--resume", "--set", "data.bad_image=repeat")
    assert run_command(arguments(other, *passing, source=str(folder), scale=0.5)) == 0
    assert [line["frame"] for line in metrics(other)] == [0, 1, 2, 3]
    (folder / "cam00" / "000003.jpg").write_bytes(sound)
    stream = encode(out, "--resume", source=str(folder), scale=0.5)
    assert stream == encode(tmp_path / "whole", source=str(folder), scale=0.5)
    assert (other / "stream.gss").read_bytes() != stream


def test_frames_that_are_made_again_are_named(broken, tmp_path, capsys) -> None:
    """A kill has lost the lines of frames that the stream holds: making them again may take hours."""
    folder, out, _ = broken
    other = Path(shutil.copytree(out, tmp_path / "o"))
    lines = (other / "metrics.jsonl").read_text().splitlines(keepends=True)
    (other / "metrics.jsonl").write_text("".join(lines[:1] + lines[2:]))
    assert run_command(arguments(other, "--resume", "--frames", "3", source=str(folder), scale=0.5)) == 0
    said = capsys.readouterr().err
    assert f"no line of frame 1, though stream.gss has its packet: frames 1 to {len(lines) - 1}" in said
    assert [line["frame"] for line in metrics(other)] == [0, 1, 2]
    with StreamReader(other / "stream.gss") as reader:
        assert [entry.frame for entry in reader.frames] == [0, 1, 2]
