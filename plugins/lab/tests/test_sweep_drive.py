"""The one loop of sweeps and their tables: resuming, and workers that die."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
import sweep_works
from gsstream_lab.jobs.base import Finished
from gsstream_lab.jobs.executor import LocalExecutor
from gsstream_lab.jobs.schedule import RETRIES, finished_tasks
from gsstream_lab.sweep.drive import cell_file, run_sweep
from gsstream_lab.sweep.table import TableWriter, read_table
from hypothesis import given
from hypothesis import strategies as st
from sweep_works import TWO_SEEDS

from gsstream.core.errors import InputError, OutputError


def lines(out: Path, record: str) -> list[dict]:
    rows = [json.loads(line) for line in (out / "table.jsonl").read_text().splitlines()]
    return [row for row in rows if row["record"] == record]


def sweep(plan, out, work=sweep_works.make, workers=2, **options):
    said: list[str] = []
    return run_sweep(plan, out, LocalExecutor(workers, 1, work), say=said.append, **options), said


def test_every_cell_is_made_once_and_given_its_frame_0(plan_of, tmp_path):
    plan, out = plan_of(TWO_SEEDS), tmp_path / "out"
    result, said = sweep(plan, out)
    assert (result.made, result.kept, dict(result.failed)) == (4, 0, {})
    assert sorted(row["id"] for row in lines(out, "cell")) == sorted(plan.cells)
    assert {row["id"] for row in lines(out, "first_frame")} == set(plan.firsts)
    for key, cell in plan.cells.items():
        assert cell_file(out, key).read_bytes() == key.encode() + cell.first.encode()
    assert len(lines(out, "machine")) == 1, "what many cells share is stored once"
    assert sum("4/4" in line for line in said) == 1
    assert not (out / "work").exists()
    again, _ = sweep(plan, out, sweep_works.die)
    assert (again.made, again.kept) == (0, 4)
    assert len(lines(out, "plan")) == 1


def test_a_larger_plan_keeps_what_the_smaller_one_made(plan_of, tmp_path):
    out = tmp_path / "out"
    sweep(plan_of(TWO_SEEDS), out)
    before = (out / "table.jsonl").read_bytes()
    result, _ = sweep(plan_of(TWO_SEEDS.replace("[1, 2]", "[1, 2, 3]")), out)
    assert (result.made, result.kept) == (2, 4)
    assert (out / "table.jsonl").read_bytes().startswith(before), "the table is only appended to"
    assert len(read_table(out).plan["points"]) == 6
    assert len(lines(out, "first_frame")) == 2


def test_a_failing_cell_is_recorded_and_the_rest_goes_on(plan_of, tmp_path):
    plan, out = plan_of(TWO_SEEDS + "first_frame: {share: own}\n"), tmp_path / "out"
    result, said = sweep(plan, out, sweep_works.fail_in_seed_1)
    assert (result.made, len(result.failed)) == (4, 2)
    table = read_table(out)
    assert table.done() == {key for key, cell in plan.cells.items() if cell.seed == 0}
    bad = [row for row in table.cells.values() if row["status"] == "failed"]
    assert {row["error"] for row in bad} == {"ComponentError: gate 'x' failed"}
    assert all(row["details"] == "Traceback" for row in bad)
    assert sum("FAILED" in line for line in said) == 2
    mended, _ = sweep(plan, out)
    assert (mended.made, mended.kept, dict(mended.failed)) == (2, 2, {})
    assert read_table(out).done() == set(plan.cells)


def test_without_their_frame_0_cells_fail_with_its_reason(plan_of, tmp_path):
    plan, out = plan_of(TWO_SEEDS), tmp_path / "out"
    result, _ = sweep(plan, out, sweep_works.fail_in_seed_1)
    assert set(result.failed) == {key for key, cell in plan.cells.items() if cell.seed == 1}
    assert set(result.failed.values()) == {"frame 0: ComponentError: gate 'x' failed"}
    assert sweep(plan, out)[0].failed == {}


def test_a_worker_killed_in_a_cell_is_replaced(plan_of, tmp_path, monkeypatch):
    marks = tmp_path / "marks"
    marks.mkdir()
    monkeypatch.setenv("SWEEP_TEST_MARKS", str(marks))
    plan, out = plan_of(TWO_SEEDS), tmp_path / "out"
    result, said = sweep(plan, out, sweep_works.die_once)
    assert (result.made, dict(result.failed)) == (4, {})
    assert sum("SIGKILL" in line and "once more" in line for line in said) == 6
    assert len(lines(out, "cell")) == 4


def test_a_cell_that_kills_every_worker_ends_as_a_record(plan_of, tmp_path):
    plan, out = plan_of(TWO_SEEDS + "first_frame: {share: own}\n"), tmp_path / "out"
    result, said = sweep(plan, out, sweep_works.die)
    assert len(result.failed) == 4
    assert set(result.failed.values()) == {"the worker process ended with code 3 and no result"}
    assert sum("once more" in line for line in said) == 4


def test_workers_have_the_threads_that_were_asked_for_and_warn_in_one_line(plan_of, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    plan = plan_of(TWO_SEEDS)
    executor = LocalExecutor(1, 3, sweep_works.threads)
    from gsstream_lab.sweep.job import Job

    executor.submit(Job("x", "demo", next(iter(plan.cells.values())).resolved))
    seen = executor.next().outcome.run
    assert {seen[name] for name in ("GSSTREAM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")} == {"3"}
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert seen["said"] == "warning: so many threads\n"


def start_hanging(tmp_path: Path) -> tuple[subprocess.Popen[str], list[int]]:
    """A sweep of its own process, and the ids of two workers that are in a cell."""
    marks, config = tmp_path / "marks", tmp_path / "sweep.yaml"
    marks.mkdir(exist_ok=True)
    config.write_text(TWO_SEEDS + "first_frame: {share: own}\n")
    process = subprocess.Popen(
        [sys.executable, sweep_works.__file__, str(config), str(tmp_path / "out")],
        text=True,
        stderr=subprocess.PIPE,
        env={**os.environ, "SWEEP_TEST_MARKS": str(marks), "GSSTREAM_LOAD_PLUGINS": "lab"},
        # A job in the background of a shell ignores Ctrl-C, and so would every process that its tests start.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    deadline = time.monotonic() + 60
    while len(found := list(marks.glob("pid-*"))) < 2:
        assert time.monotonic() < deadline, "no worker has started"
        assert process.poll() is None, process.stderr and process.stderr.read()
        time.sleep(0.05)
    return process, [int(path.name.removeprefix("pid-")) for path in found]


def gone(pid: int) -> bool:
    """The process has ended (waits for it a while)."""
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        try:
            os.kill(pid, 0)
            if Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z":
                return True  # ended; whoever adopted it has not asked yet
        except (ProcessLookupError, FileNotFoundError):
            return True
        time.sleep(0.05)
    return False


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_a_stopped_sweep_leaves_no_worker_and_can_go_on(plan_of, tmp_path, how):
    process, workers = start_hanging(tmp_path)
    with process:
        process.send_signal(how)
        process.wait(300)
    assert all(gone(pid) for pid in workers)
    plan, out = plan_of(TWO_SEEDS + "first_frame: {share: own}\n"), tmp_path / "out"
    result, _ = sweep(plan, out)
    assert (result.made, result.kept) == (4, 0)


def test_two_sweeps_never_share_a_folder(plan_of, tmp_path):
    process, _ = start_hanging(tmp_path)
    with process:
        with pytest.raises(OutputError, match="another sweep"):
            sweep(plan_of(TWO_SEEDS), tmp_path / "out")
        process.kill()


def test_a_table_cut_in_a_line_loses_that_line_alone(plan_of, tmp_path):
    plan, out = plan_of(TWO_SEEDS), tmp_path / "out"
    sweep(plan, out, workers=1)
    content = (out / "table.jsonl").read_bytes()
    last = content.rstrip(b"\n").rfind(b"\n") + 1
    for end in (last + 1, (last + len(content)) // 2, len(content) - 1):
        (out / "table.jsonl").write_bytes(content[:end])
        assert len(read_table(out).done()) == 3
        writer = TableWriter(out)
        writer.append("machine", {"id": "new"})
        assert len(read_table(out).cells) == 3
        assert "new" in read_table(out).machines
    (out / "table.jsonl").write_bytes(content[: last + 5])
    assert sweep(plan, out)[0].made == 1


@pytest.mark.parametrize("text", ["nonsense\n", "[1]\n", '{"record": "cell"}\n', '{"record": "what", "id": "x"}\n'])
def test_what_is_no_table_is_refused_by_line(tmp_path, text):
    (tmp_path / "table.jsonl").write_text('{"record": "machine", "id": "m"}\n' + text)
    with pytest.raises(InputError, match=r"table\.jsonl:2"):
        read_table(tmp_path)
    with pytest.raises(InputError, match="cannot read"):
        read_table(tmp_path / "elsewhere")


@dataclass(frozen=True)
class Step:
    """A task that waits for another, whose worker dies ``deaths`` times before it is done or fails."""

    id: str
    after: str | None
    deaths: int
    fails: bool


class Scripted:
    """An executor that does what its tasks say, and ends them in any order."""

    def __init__(self, slots: int, order: st.DataObject) -> None:
        self.slots, self.order = slots, order
        self.running: list[Step] = []
        self.starts: list[str] = []

    def submit(self, job: Step) -> None:
        self.running.append(job)
        self.starts.append(job.id)
        assert len(self.running) <= self.slots

    def next(self) -> Finished:
        job = self.running.pop(self.order.draw(st.integers(0, len(self.running) - 1)))
        dead = self.starts.count(job.id) <= job.deaths
        return Finished(job.id, None if dead else job, "died" if dead else "")

    def close(self) -> None:
        self.running.clear()


@st.composite
def steps(draw: st.DrawFn) -> list[Step]:
    """A forest of jobs in any order: a job that others wait for may stand later in the list."""
    number = draw(st.integers(0, 8))
    needs = [draw(st.none() | st.integers(0, k - 1)) if k else None for k in range(number)]
    deaths = st.integers(0, RETRIES + 1)
    made = [
        Step(f"t{k}", None if needs[k] is None else f"t{needs[k]}", draw(deaths), draw(st.booleans()))
        for k in range(number)
    ]
    return draw(st.permutations(made))


@given(tasks=steps(), slots=st.integers(1, 4), order=st.data())
def test_every_task_ends_once_whatever_dies_or_fails(tasks: list[Step], slots: int, order: st.DataObject) -> None:
    executor, have, ended, again = Scripted(slots, order), set[str](), dict[str, Finished | None](), list[str]()

    def start(task: Step) -> Step:
        assert task.after is None or task.after in have, "it goes on from what is not there"
        return task

    for task, finished in finished_tasks(
        tasks, executor, have, after=lambda t: t.after, job=start, lost=lambda t, why: again.append(f"{t.id} {why}")
    ):
        assert task.id not in ended
        ended[task.id] = finished
        if finished is not None and finished.outcome is not None and not task.fails:
            have.add(task.id)
    by_id = {task.id: task for task in tasks}
    assert ended.keys() == by_id.keys()
    for task in tasks:
        needed, finished = by_id.get(task.after or ""), ended[task.id]
        good = needed is None or needed.id in have
        assert (finished is not None) == good, "exactly what nobody can start comes without having run"
        assert executor.starts.count(task.id) == (min(task.deaths, RETRIES) + 1 if good else 0)
        assert again.count(f"{task.id} died") == (min(task.deaths, RETRIES) if good else 0)
        if finished is not None:
            assert (finished.outcome is None) == (task.deaths > RETRIES)
            assert finished.outcome is not None or finished.reason == "died"


@given(slots=st.integers(1, 3))
def test_what_is_there_already_needs_no_run_and_what_never_comes_is_said(slots: int) -> None:
    tasks = [Step("b", "a", 0, False), Step("d", "c", 0, False), Step("e", "d", 0, False)]
    executor = Scripted(slots, None)  # type: ignore[arg-type]
    executor.next = lambda: Finished(executor.running[0].id, executor.running.pop(0))  # type: ignore[method-assign]
    found = list(finished_tasks(tasks, executor, {"a"}, after=lambda t: t.after, job=lambda t: t, lost=print))
    assert {task.id: finished is None for task, finished in found} == {"b": False, "d": True, "e": True}
    assert executor.starts == ["b"]
