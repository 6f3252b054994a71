"""Runs the tasks of a plan on an executor: a task starts once the one that it goes on from is there."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from gsstream.core.errors import GsstreamError
from gsstream.engine.run.session import METRICS, RECIPE
from gsstream.recipe.load import ResolvedRecipe
from gsstream.trade.jobs.base import Executor, Finished
from gsstream.trade.jobs.schedule import finished_tasks
from gsstream.trade.measure.records import read_lines
from gsstream.trade.segments.job import SegmentJob, SegmentOutcome
from gsstream.trade.segments.join import Seam, join, seams
from gsstream.trade.segments.plan import STREAM, SegmentPlan, Task

KEY_STREAMS = "first.gss"


@dataclass(frozen=True, slots=True)
class SegmentsResult:
    """The joined stream and metrics in the output folder, the tasks made and kept, and the seams."""

    frames: int
    made: int
    kept: int
    seams: list[Seam] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Setting:
    """What all tasks have in common.

    Arguments:
        uri: the recording, as every worker opens it.
        resolved: recipe of the segments; ``carrying``: of the steps from key frame to key frame.
        local: workers see the output folder, so a killed one's task goes on where it stopped.
    """

    uri: str
    resolved: ResolvedRecipe
    carrying: ResolvedRecipe
    local: bool = True


def run_segments(
    plan: SegmentPlan, setting: Setting, out: Path, executor: Executor, *, say: Callable[[str], None] = print
) -> SegmentsResult:
    """Make every task that ``out`` does not hold whole, then join the segments into ``out/stream.gss``.

    Arguments:
        plan: tasks, and what each waits for.
        setting: what all tasks share.
        out: folder of the run.
        executor: that runs the tasks.
        say: called with lines for a person.

    Raises GsstreamError when a segment fails; what is finished stays, and the same call goes on. KeyboardInterrupt
    passes through; no worker is left.
    """
    try:
        made, kept = _Drive(plan, setting, out, executor, say).run()
    finally:
        executor.close()
    folders = [out / task.id for task in plan.segments]
    join([folder / STREAM for folder in folders], out / STREAM)
    frames = [line for folder in folders for line in read_lines(folder / METRICS)]
    (out / METRICS).write_text("".join(json.dumps(frame) + "\n" for frame in frames), encoding="utf-8")
    shutil.copyfile(folders[0] / RECIPE, out / RECIPE)
    return SegmentsResult(len(frames), made, kept, seams(plan.seams, frames))


class _Drive:
    """The moving parts; lives only inside :func:`run_segments`."""

    def __init__(
        self, plan: SegmentPlan, setting: Setting, out: Path, executor: Executor, say: Callable[[str], None]
    ) -> None:
        self.setting, self.out, self.executor, self.say = setting, out, executor, say
        self.tasks = {task.id: task for task in (*plan.keys, *plan.segments)}
        self.keys = {task.id for task in plan.keys}
        self.have = {task.id for task in self.tasks.values() if task.done(out)}

    def run(self) -> tuple[int, int]:
        kept = len(self.have)
        waiting = [task for task in self.tasks.values() if task.id not in self.have]
        for task, finished in finished_tasks(
            waiting, self.executor, self.have, after=_after, job=self._job, lost=self._lost
        ):
            assert finished is not None, "a task that fails ends the run before others miss its result"
            self._finish(task, finished)
        return len(self.tasks) - kept, kept

    def _lost(self, task: Task, reason: str) -> None:
        """A task starts again; where workers see its folder, it goes on where the dead one stopped."""
        self.say(f"{_label(task)}: {reason}; goes on")

    def _job(self, task: Task) -> SegmentJob:
        first = None
        if task.after is not None:
            first = (self.out / KEY_STREAMS if task.after == "first" else self.out / task.after / STREAM).read_bytes()
        key = task.id in self.keys
        return SegmentJob(
            task.id, self.setting.uri, self.setting.carrying if task.shown is not None else self.setting.resolved,
            task.frames, first, task.shown, measure=not key,
            work=str((self.out / task.id).resolve()) if self.setting.local else None,
        )  # fmt: skip

    def _finish(self, task: Task, finished: Finished) -> None:
        outcome: SegmentOutcome = finished.outcome or SegmentOutcome(task.id, finished.reason)
        if outcome.error is None and outcome.files:
            (self.out / task.id).mkdir(exist_ok=True)
            for name, content in outcome.files:
                (self.out / task.id / name).write_bytes(content)
        if outcome.error is None and not task.done(self.out):
            outcome = replace(outcome, error="it ended without an error and without all of its frames")
        if outcome.error is not None:
            raise GsstreamError(
                f"{_label(task)} failed: {outcome.error}; what is finished is kept, --resume goes on from it"
            )
        self.have.add(task.id)
        self.say(f"[{len(self.have)}/{len(self.tasks)}] {_label(task)} done")


def _after(task: Task) -> str | None:
    """The task that one waits for; a given frame 0 is there from the start."""
    return None if task.after == "first" else task.after


def _label(task: Task) -> str:
    last = task.frames.stop - 1
    if not task.id.startswith("key"):
        return f"{task.id}: frames {task.frames.start} to {last}"
    return f"{task.id}: " + (f"frame {last} reconstructed" if task.shown is None else f"{task.shown} carried to {last}")
