"""The one loop of sweeps: nothing starts too early, too often or not at all, whoever dies or fails."""

from __future__ import annotations

from dataclasses import dataclass

from gsstream_lab.jobs.base import Finished
from gsstream_lab.jobs.schedule import RETRIES, finished_tasks
from hypothesis import given
from hypothesis import strategies as st


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
    """A forest in any order: what is waited for may stand later in the list."""
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
