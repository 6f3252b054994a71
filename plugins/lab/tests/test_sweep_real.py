"""A real sweep through the command line, killed with -9 in a cell and continued."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from gsstream_lab.sweep.table import read_table
from sweep_works import REAL

from gsstream.cli.main import run_command
from gsstream.core.errors import InputError
from gsstream.player.playback import Playback


def start(config: Path, out: Path) -> subprocess.Popen[str]:
    code = "from gsstream.cli.main import main; main()"
    command = [sys.executable, "-c", code, "sweep", str(config), "--out", str(out), "--workers", "1"]
    environment = {**os.environ, "GSSTREAM_LOAD_PLUGINS": "gsstream-cpu-render,lab"}
    return subprocess.Popen(command, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment)


def cells_of(out: Path) -> list[dict]:
    path = out / "table.jsonl"
    rows = [json.loads(line) for line in path.read_text().splitlines(keepends=True) if line.endswith("\n")]
    return [row for row in rows if row["record"] == "cell"]


def test_a_killed_sweep_goes_on_without_repeating_a_cell(tmp_path):
    config, out = tmp_path / "sweep.yaml", tmp_path / "out"
    config.write_text(REAL)
    with start(config, out) as process:
        deadline = time.monotonic() + 300
        # One cell is in the table, and the next one has begun to write its stream.
        while not ((out / "table.jsonl").exists() and cells_of(out) and list(out.glob("work/cell-*/stream.gss"))):
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < deadline, "the second cell has not started"
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
        process.wait(300)
    first = cells_of(out)
    assert len(first) == 1
    stream = out / "cells" / f"{first[0]['id']}.gss"
    made = stream.stat().st_mtime_ns
    with start(config, out) as process:
        text, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors
    assert "1 cell made, 1 kept" in text
    rows = cells_of(out)
    assert rows[0] == first[0]
    assert len(rows) == 2
    assert stream.stat().st_mtime_ns == made
    assert sorted(row["axes"]["stream.epochs"] for row in rows) == [1, 2]
    table = read_table(out)
    assert len(table.first_frames) == 1, "frame 0 was made once, by the sweep that was killed"
    _check_cells(table, out)


def _check_cells(table, out: Path) -> None:
    """What stands in the table is what lies in the streams."""
    for key, row in table.cells.items():
        with Playback(out / "cells" / f"{key}.gss") as playback:
            assert [frame["frame"] for frame in row["frames"]] == list(playback.frames) == [0, 1]
            size = (out / "cells" / f"{key}.gss").stat().st_size
            written = sum(sum(frame["bytes"].values()) for frame in row["frames"])
            assert 0 <= size - written < 200, "all but the index at the end is counted"
        recipe = table.recipes[row["recipe"]]["values"]
        assert recipe["stream"]["epochs"] == row["axes"]["stream.epochs"]
        assert recipe["renderer"]["name"] == "cpu", "the recipe is that of the live parts, 'auto' resolved"
        facts = table.machines[row["machine"]]["facts"]
        assert facts["distributions"]["gsstream"] == facts["gsstream"]
        assert row["fps"] > 0
        assert row["threads"] == "1"
        for frame in row["frames"]:
            assert frame["cpu_seconds"] > 0
            assert frame["peak_memory_mb"] > 50
            assert all(value > 3 for value in frame["psnr"].values())


def test_a_dry_run_shows_the_plan_and_writes_nothing(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("GSSTREAM_LOAD_PLUGINS", "lab")
    config, out = tmp_path / "sweep.yaml", tmp_path / "out"
    config.write_text(REAL)
    assert run_command(["sweep", str(config), "--out", str(out), "--dry-run"]) == 0
    text = capsys.readouterr().out
    assert text.count("to make\n") == 2
    assert "2 cells, 2 to make; 1 shared frame 0 to make first" in text
    assert not out.exists()
    with pytest.raises(InputError):
        read_table(out)
