"""Real sweeps: killed with -9 in a cell and continued; on Ray, whose workers are killed."""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import sweep_works
from gsstream_lab.jobs.executor import LocalExecutor
from gsstream_lab.jobs.ray_executor import RayExecutor
from gsstream_lab.sweep.drive import run_sweep
from gsstream_lab.sweep.job import run_job
from gsstream_lab.sweep.table import read_table
from sweep_works import REAL

from gsstream.cli.main import run_command
from gsstream.core.errors import InputError, PluginUnavailable
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
    """The numbers of the table are those of the streams."""
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


HAVE_RAY = importlib.util.find_spec("ray") is not None
needs_ray = pytest.mark.skipif(not HAVE_RAY, reason="needs Ray (extra: ray)")


@pytest.fixture
def marks(tmp_path, monkeypatch):
    """Where the workers of these tests leave their ids; also on the path of Ray's workers."""
    folder = tmp_path / "marks"
    folder.mkdir()
    monkeypatch.setenv("SWEEP_TEST_MARKS", str(folder))
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))
    return folder


def kill_first_worker(marks: Path, killed: list[int]) -> None:
    """From outside, as the system would: -9 to the first worker that is in a cell."""
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        for path in marks.glob("pid-*"):
            pid = int(path.name.removeprefix("pid-"))
            if pid not in killed:
                os.kill(pid, signal.SIGKILL)
                killed.append(pid)
        if len(killed) >= 2:
            return
        time.sleep(0.05)


@needs_ray
@pytest.mark.slow
def test_ray_workers_killed_in_a_cell_are_replaced_and_make_the_streams_of_local_ones(
    plan_of, tmp_path, monkeypatch, marks
):
    monkeypatch.setenv("GSSTREAM_LOAD_PLUGINS", "gsstream-cpu-render")
    plan, out = plan_of(REAL + "first_frame: {share: own}\n"), tmp_path / "ray"
    said: list[str] = []
    killed: list[int] = []
    thread = threading.Thread(target=kill_first_worker, args=(marks, killed))
    thread.start()
    result = run_sweep(plan, out, RayExecutor("local", 2, 1, sweep_works.hang_then_run), say=said.append)
    thread.join()
    assert len(killed) == 2
    assert (result.made, dict(result.failed)) == (2, {})
    assert sum("Ray worker was lost" in line and "once more" in line for line in said) == 2
    rows = [json.loads(line) for line in (out / "table.jsonl").read_text().splitlines()]
    assert sorted(row["id"] for row in rows if row["record"] == "cell") == sorted(plan.cells)
    run_sweep(plan, tmp_path / "local", LocalExecutor(1, 1, run_job))
    assert read_table(out).done() == read_table(tmp_path / "local").done() == set(plan.cells)
    for key in plan.cells:
        name = Path("cells") / f"{key}.gss"
        assert (out / name).read_bytes() == (tmp_path / "local" / name).read_bytes()


@pytest.mark.skipif(HAVE_RAY, reason="Ray is installed; this is about its absence")
def test_without_ray_the_extra_is_named():
    with pytest.raises(PluginUnavailable, match=r"gsstream\[ray\]"):
        RayExecutor("local", 1, 1, run_job)
