"""Runs a plan: frames 0 first, cells as soon as theirs is there; every result is on disk before the next is awaited."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsstream.core.errors import OutputError
from gsstream.engine.run.output import run_lock
from gsstream.evaluation.records import mean, mean_of_views
from gsstream_lab.jobs.base import Executor, Finished
from gsstream_lab.jobs.folder import recording_uri
from gsstream_lab.jobs.schedule import finished_tasks
from gsstream_lab.sweep.job import Job, Outcome
from gsstream_lab.sweep.plan import Cell, FirstFrameRun, Plan
from gsstream_lab.sweep.table import FORMAT, TableWriter

FIRST_FRAMES, CELLS, WORK = "first_frames", "cells", "work"


@dataclass(frozen=True, slots=True)
class SweepResult:
    """How a sweep ended: runs made now, those that were there already, and those that failed with their reason."""

    made: int
    kept: int
    failed: Mapping[str, str] = field(default_factory=dict)


def run_sweep(
    plan: Plan, out: Path, executor: Executor, *, data: Path | None = None, say: Callable[[str], None] = print
) -> SweepResult:
    """Make every cell of a plan that the table in ``out`` does not hold yet.

    Raises OutputError when another sweep works in ``out`` or it cannot be written. KeyboardInterrupt passes through,
    with everything that is finished on disk and no worker left.
    """
    try:
        for folder in (out, out / FIRST_FRAMES, out / CELLS):
            folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"the output folder {out} cannot be used: {error}") from error
    with run_lock(out, "sweep"):
        shutil.rmtree(out / WORK, ignore_errors=True)
        (out / WORK).mkdir()
        try:
            return _Drive(plan=plan, out=out, executor=executor, data=data, say=say).run()
        finally:
            executor.close()
            shutil.rmtree(out / WORK, ignore_errors=True)


class _Drive:
    """The moving parts of a sweep; lives only inside :func:`run_sweep`."""

    def __init__(
        self, plan: Plan, out: Path, executor: Executor, data: Path | None, say: Callable[[str], None]
    ) -> None:
        self.plan, self.out, self.executor, self.data, self.say = plan, out, executor, data, say
        self.table = TableWriter(out)
        cells, done = plan.cells, self.table.data.done()
        self.kept = [key for key in cells if key in done]
        self.cells = {key: cell for key, cell in cells.items() if key not in done}
        made = (key for key, row in self.table.data.first_frames.items() if row["status"] == "done")
        self.have = {key for key in made if first_frame_file(out, key).is_file()}
        self.failed: dict[str, str] = {}
        self.failed_firsts: dict[str, str] = {}
        self.made, self.started = 0, time.monotonic()

    def run(self) -> SweepResult:
        self._write_plan()
        needed = dict.fromkeys(cell.first for cell in self.cells.values() if cell.first and cell.first not in self.have)
        waiting: list[Cell | FirstFrameRun] = [self.plan.firsts[key] for key in needed]
        waiting += self.cells.values()
        for task, finished in finished_tasks(
            waiting, self.executor, self.have, after=_first_of, job=self._job, lost=self._lost
        ):
            if isinstance(task, Cell):
                self._after_cell(task, finished)
            else:
                assert finished is not None, "a frame 0 waits for nothing"
                self._after_first_frame(task, finished)
        return SweepResult(self.made, len(self.kept), self.failed)

    def _lost(self, task: Cell | FirstFrameRun, reason: str) -> None:
        self.say(f"{task.label}: {reason}; once more")

    def _job(self, task: Cell | FirstFrameRun) -> Job:
        uri, work = recording_uri(task.scene.uri, self.data), str((self.out / WORK).resolve())
        alone = self.executor.slots == 1
        if isinstance(task, FirstFrameRun):
            return Job(task.id, uri, task.resolved, work=work, alone=alone)
        first = first_frame_file(self.out, task.first).read_bytes() if task.first else None
        return Job(
            id=task.id,
            uri=uri,
            resolved=task.resolved,
            first_frame=first,
            measure=self.plan.config.measure,
            work=work,
            alone=alone,
        )

    def _after_first_frame(self, task: FirstFrameRun, finished: Finished) -> None:
        outcome = finished.outcome or Outcome(task.id, error=finished.reason)
        if outcome.error is None:
            write_whole(first_frame_file(self.out, task.id), outcome.stream)
        self._record("first_frame", task, outcome, {})
        if outcome.error is None:
            self.have.add(task.id)
            self.say(f"{task.label}: {_seconds(outcome):.0f} s")
        else:
            self.failed_firsts[task.id] = outcome.error
            self.say(f"{task.label}: FAILED: {outcome.error}")

    def _after_cell(self, cell: Cell, finished: Finished | None) -> None:
        """Record a cell; one that could not start fails with the reason of its frame 0."""
        if finished is None:
            outcome = Outcome(cell.id, error=f"frame 0: {self.failed_firsts[cell.first or '']}")
        else:
            outcome = finished.outcome or Outcome(cell.id, error=finished.reason)
        if outcome.error is None:
            write_whole(cell_file(self.out, cell.id), outcome.stream)
        place = {"scene": cell.scene.name, "variant": cell.variant, "axes": dict(cell.axes), "seed": cell.seed}
        self._record(
            "cell", cell, outcome, {**place, "first_frame": cell.first, "frame_0_of": self.plan.frame_0_of(cell)}
        )
        self.made += 1
        count = f"[{len(self.kept) + self.made}/{len(self.kept) + len(self.cells)}]"
        if outcome.error is not None:
            self.failed[cell.id] = outcome.error
            self.say(f"{count} {cell.label}: FAILED: {outcome.error}")
            return
        left = (len(self.cells) - self.made) * (time.monotonic() - self.started) / self.made
        self.say(f"{count} {cell.label}: {summary_line(outcome.frames)}; about {left / 60:.0f} min left")

    def _record(self, record: str, task: Cell | FirstFrameRun, outcome: Outcome, place: Mapping[str, Any]) -> None:
        values: dict[str, Any] = {"id": task.id, **place}
        if outcome.error is not None:
            self.table.append(
                record, {**values, "status": "failed", "error": outcome.error, "details": outcome.details}
            )
            return
        machine = stable_id(outcome.machine)
        self.table.append_once("machine", machine, {"facts": dict(outcome.machine)})
        self.table.append_once("recipe", outcome.recipe_hash, {"values": dict(outcome.recipe)})
        values |= {"status": "done", "recipe": outcome.recipe_hash, "machine": machine, "workers": self.executor.slots}
        self.table.append(record, {**values, **outcome.run, "frames": list(outcome.frames)})

    def _write_plan(self) -> None:
        config = self.plan.config
        points = [
            {"cell": p.id, "scene": p.scene.name, "variant": p.variant, "axes": dict(p.axes), "seed": p.seed}
            for p in self.plan.points
        ]
        values = {"format": FORMAT, "config": config.model_dump(mode="json"), "points": points}
        known = self.table.data.plan
        if known is None or {**values, "record": "plan"} != known:
            self.table.append("plan", values)


def _first_of(task: Cell | FirstFrameRun) -> str | None:
    """The frame 0 that a task waits for."""
    return task.first if isinstance(task, Cell) else None


def stable_id(facts: Mapping[str, Any]) -> str:
    """Return a short id of a machine's facts."""
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:12]


def first_frame_file(out: Path, key: str) -> Path:
    """Return where a shared frame 0 lies."""
    return out / FIRST_FRAMES / f"{key}.gss"


def cell_file(out: Path, key: str) -> Path:
    """Return where the stream of a cell lies."""
    return out / CELLS / f"{key}.gss"


def write_whole(path: Path, content: bytes) -> None:
    """Write a file that is there whole or not at all. Raises OutputError."""
    part = path.with_suffix(".part")
    try:
        part.write_bytes(content)
        os.replace(part, path)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}; free some space and go on") from error


def summary_line(frames: Sequence[Mapping[str, Any]]) -> str:
    """Return ``31.22 dB (moving 29.27), 25.6 KB, 0.45 s/frame``: means over the frames after the first."""
    later = frames[1:] or frames
    whole, moving = (mean_of_views(later, name) for name in ("psnr", "psnr_moving"))
    size, seconds = (mean(sum(frame[name].values()) for frame in later) for name in ("bytes", "seconds"))
    return f"{whole:.2f} dB (moving {moving:.2f}), {size / 1000:.1f} KB, {seconds:.2f} s/frame"


def _seconds(outcome: Outcome) -> float:
    return float(sum(outcome.frames[0]["seconds"].values()))
