"""Runs a batch: what has a note is kept, everything else is made, and made again when its worker dies."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

from gsstream.core.errors import OutputError
from gsstream.engine.run.output import run_lock
from gsstream.recipe.load import recipe_hash
from gsstream.store.place import Folder, Place
from gsstream_lab.batch.plan import Task
from gsstream_lab.batch.work import NOTE, BatchJob, BatchOutcome, bring
from gsstream_lab.jobs.base import Executor, Finished
from gsstream_lab.jobs.schedule import finished_tasks

#: Room for what the next recording may take beyond the largest before it.
MARGIN = 1.25
_ROW = "{count:>9}  {name:<24.24} {frames:>6} {psnr:>7} {kb:>9} {seconds:>8}  {state}"
HEAD = _ROW.format(count="", name="recording", frames="frames", psnr="dB", kb="KB/frame", seconds="s", state="")


@dataclass(frozen=True, slots=True)
class BatchResult:
    """How a batch ended: made now, there already, and failed with their reasons, by the names of the recordings."""

    made: int
    kept: int
    failed: Mapping[str, str] = field(default_factory=dict)


def run_batch(tasks: list[Task], place: Place, executor: Executor, *, say: Callable[[str], Any] = print) -> BatchResult:
    """Make what is not at the place yet.

    Raises OutputError when another batch writes to the folder, or nothing can be written. KeyboardInterrupt passes
    through with no worker left; what is finished stays.
    """
    with ExitStack() as stack:
        stack.callback(executor.close)
        if isinstance(place, Folder):
            try:
                place.path.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise OutputError(f"the folder {place.path} cannot be used: {error.strerror or error}") from error
            stack.enter_context(run_lock(place.path, "batch"))
        return _Drive(tasks, place, executor, say).run()


class _Drive:
    """The moving parts of a batch; lives only inside :func:`run_batch`."""

    def __init__(self, tasks: list[Task], place: Place, executor: Executor, say: Callable[[str], Any]) -> None:
        self.place, self.executor, self.say, self.total = place, executor, say, len(tasks)
        #: Recipe -> bytes that the largest of its runs so far has taken.
        self.peaks: dict[str, int] = {}
        there, self.over = set(place.names()), 0
        self.failed: dict[str, str] = {}
        self.waiting: list[Task] = []
        say(HEAD)
        for task in tasks:
            note = place.read(f"{task.folder}/{NOTE}") if f"{task.folder}/{NOTE}" in there else None
            if note is None:
                self.waiting.append(task)
            else:
                self._row(task, json.loads(note), "kept")
        self.kept = self.over

    def run(self) -> BatchResult:
        for task, finished in _finished(self.waiting, self.executor, self._job, self._lost):
            outcome: BatchOutcome = finished.outcome or BatchOutcome(task.id, error=finished.reason)
            if outcome.error is None and outcome.files:
                bring(outcome.files, self.place.address)
            if outcome.error is not None:
                self.failed[task.name] = outcome.error
            self._row(task, outcome.facts, "made" if outcome.error is None else f"FAILED: {outcome.error}")
        return BatchResult(len(self.waiting) - len(self.failed), self.kept, self.failed)

    def _job(self, task: Task) -> BatchJob:
        to = None if isinstance(self.place, Folder) else self.place.address
        memory = int(MARGIN * self.peaks.get(recipe_hash(task.resolved.recipe), 0))
        return BatchJob(task.id, task.uri, task.resolved, folder=task.folder, to=to, memory=memory)

    def _lost(self, task: Task, reason: str) -> None:
        self.say(f"{task.name}: {reason}; once more")

    def _row(self, task: Task, facts: Mapping[str, Any], state: str) -> None:
        """Print a line of the table, and remember what the run took."""
        self.over += 1
        if facts:
            key = str(facts["recipe"])
            self.peaks[key] = max(self.peaks.get(key, 0), int(1e6 * facts["peak_mb"]))
        frames, psnr = facts.get("frames", 0), facts.get("psnr")
        cells = {
            "frames": frames or "",
            "psnr": "" if psnr is None else f"{psnr:.2f}",
            "kb": f"{facts['bytes'] / 1000 / frames:.1f}" if frames else "",
            "seconds": f"{facts['seconds']:.0f}" if frames else "",
        }
        self.say(_ROW.format(count=f"[{self.over}/{self.total}]", name=task.name, state=state, **cells))


def _finished(
    tasks: Iterable[Task],
    executor: Executor,
    job: Callable[[Task], BatchJob],
    lost: Callable[[Task, str], None],
) -> Iterable[tuple[Task, Finished]]:
    """Every task with what came of it; none waits for another."""
    for task, finished in finished_tasks(tasks, executor, set(), after=lambda _: None, job=job, lost=lost):
        assert finished is not None, "it waits for nothing"
        yield task, finished
