"""The same sweep on Ray: a local cluster of two workers, one of them killed in a cell."""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import threading
import time
from pathlib import Path

import pytest
import sweep_works
from gsstream_lab.jobs.ray_executor import RayExecutor
from gsstream_lab.sweep.drive import run_sweep
from gsstream_lab.sweep.job import run_job
from gsstream_lab.sweep.table import read_table
from sweep_works import REAL, TWO_SEEDS

from gsstream.core.errors import PluginUnavailable

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
def test_ray_workers_killed_in_a_cell_are_replaced(plan_of, tmp_path, marks):
    plan, out = plan_of(TWO_SEEDS.replace("[0, 1]", "[0]") + "first_frame: {share: own}\n"), tmp_path / "out"
    said: list[str] = []
    killed: list[int] = []
    thread = threading.Thread(target=kill_first_worker, args=(marks, killed))
    thread.start()
    result = run_sweep(plan, out, RayExecutor("local", 2, 1, sweep_works.hang_once), say=said.append)
    thread.join()
    assert len(killed) == 2
    assert (result.made, dict(result.failed)) == (2, {})
    assert sum("Ray worker was lost" in line and "once more" in line for line in said) == 2
    rows = [json.loads(line) for line in (out / "table.jsonl").read_text().splitlines()]
    assert sorted(row["id"] for row in rows if row["record"] == "cell") == sorted(plan.cells)


@needs_ray
@pytest.mark.slow
def test_ray_makes_the_very_streams_that_local_workers_make(plan_of, tmp_path, monkeypatch, marks):
    from gsstream_lab.jobs.executor import LocalExecutor

    monkeypatch.setenv("GSSTREAM_LOAD_PLUGINS", "gsstream-cpu-render")
    plan = plan_of(REAL)
    run_sweep(plan, tmp_path / "ray", RayExecutor("local", 2, 1, run_job))
    run_sweep(plan, tmp_path / "local", LocalExecutor(1, 1, run_job))
    assert read_table(tmp_path / "ray").done() == read_table(tmp_path / "local").done() == set(plan.cells)
    for key in plan.cells:
        name = Path("cells") / f"{key}.gss"
        assert (tmp_path / "ray" / name).read_bytes() == (tmp_path / "local" / name).read_bytes()


@pytest.mark.skipif(HAVE_RAY, reason="Ray is installed; this is about its absence")
def test_without_ray_the_extra_is_named():
    with pytest.raises(PluginUnavailable, match=r"gsstream\[ray\]"):
        RayExecutor("local", 1, 1, run_job)
