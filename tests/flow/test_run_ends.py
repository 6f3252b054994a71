"""How runs end from outside: by a service, beside another run, on a disk that is full."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest
from flow_runs import arguments, encode, metrics, start

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
    with start(*arguments(out, source=LONG)) as process:
        until(out / "stream.gss", 3000, process)
        os.kill(process.pid, signal.SIGSTOP)  # it must not come to its end while the second run is tried
        recipe = (out / "recipe.yaml").read_bytes()
        assert run_command(arguments(out, "--overwrite", "--seed", "7", source=LONG)) == 2
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
    import shutil

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
