"""Tasks on an executor: each starts once what it waits for is there, and again when its worker was lost."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Protocol, TypeVar

from gsstream_lab.jobs.base import Executor, Finished

#: A worker that dies is given its task again this often.
RETRIES = 1


class Task(Protocol):
    """Something to do, known by its id."""

    @property
    def id(self) -> str:
        """Unique among all tasks; the job of a task has the same id."""


T = TypeVar("T", bound=Task)


def finished_tasks(
    tasks: Iterable[T],
    executor: Executor,
    have: set[str],
    *,
    after: Callable[[T], str | None],
    job: Callable[[T], Any],
    lost: Callable[[T, str], None],
) -> Iterator[tuple[T, Finished | None]]:
    """Run tasks and yield each once it is over, in the order in which they end.

    A task comes with its outcome; without one (``Finished.outcome`` is None) when every worker that had it died; with
    None when it never started, because what it waits for is over and not in ``have``.
    """
    waiting, running = list(tasks), dict[str, T]()
    deaths: Counter[str] = Counter()
    while waiting or running:
        if hopeless := _hopeless(waiting, {*have, *running, *(task.id for task in waiting)}, after):
            for task in hopeless:
                waiting.remove(task)
                yield task, None
            continue
        places = max(0, executor.slots - len(running))
        for task in [task for task in waiting if (need := after(task)) is None or need in have][:places]:
            waiting.remove(task)
            running[task.id] = task
            executor.submit(job(task))
        finished = executor.next()
        task = running.pop(finished.id)
        if finished.outcome is None and deaths[task.id] < RETRIES:
            deaths[task.id] += 1
            lost(task, finished.reason)
            waiting.insert(0, task)
            continue
        yield task, finished


def _hopeless(waiting: list[T], coming: set[str], after: Callable[[T], str | None]) -> list[T]:
    """Tasks that wait for what is neither there nor coming."""
    return [task for task in waiting if (need := after(task)) is not None and need not in coming]
