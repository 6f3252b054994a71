"""A run: source -> method -> packets on disk, with metrics. Ends cleanly after the current frame on Ctrl-C."""

from __future__ import annotations

import functools
import itertools
import json
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from gsstream.core.cameras import Cameras
from gsstream.core.frame import Frame, PointCloud
from gsstream.core.rng import Rng
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.auto.rules import lines, recall, record, stream_extra
from gsstream.engine.frame0.begin import begin, begin_from, cloud_of
from gsstream.engine.budget.controller import Controller
from gsstream.engine.budget.memory import within_memory
from gsstream.engine.budget.pace import CLOCKS, Allowance
from gsstream.engine.step.frame_step import frame_step
from gsstream.engine.keys.keyframes import refresh
from gsstream.engine.run.measure import HeldOut
from gsstream.engine.run.metrics_log import last_written, trim_metrics
from gsstream.engine.frame0.points import gather_points, with_test_views
from gsstream.engine.run.progress import RunProgress
from gsstream.engine.keys.resume import resume_state
from gsstream.engine.auto.trials import choose
from gsstream.engine.whole import WholeTools, begin_whole, resume_whole, step_whole
from gsstream.method.base import MethodState, Step
from gsstream.metrics import EnergyMeter, peak_memory_mb
from gsstream.packet import PlayerState, StreamMeta, StreamWriter
from gsstream.recipe.save import save_resolved
from gsstream.source.base import FrameSource, GrowingSource, SourceInfo
from gsstream.source.prefetch import Prefetcher

#: Sees every step of a run.
Witness = Callable[[Step[Any]], None]
STREAM, METRICS, RECIPE = "stream.gss", "metrics.jsonl", "recipe.yaml"


@dataclass(frozen=True)
class RunResult:
    """Where a run ended: folder, frames written in total, and whether Ctrl-C ended it early."""

    out: Path
    frames: int
    interrupted: bool


def run(
    parts: Assembly,
    source: FrameSource,
    out: Path,
    *,
    resume: bool = False,
    quiet: bool = False,
    measure: bool = True,
    first_frame: PlayerState | None = None,
    energy: EnergyMeter | None = None,
    witness: Witness | None = None,
    span: range | None = None,
) -> RunResult:
    """Encode a recording into ``out`` (stream.gss, metrics.jsonl, recipe.yaml).

    Arguments:
        source: an open recording (``engine.run.recording.open_recording``) at the recipe's scale; the caller closes it.
        out: a prepared output folder.
        resume: continue the run that ``out`` holds; the recipe must be the same.
        measure: render and compare the test cameras of every frame.
        first_frame: frame 0 of another stream (``engine.run.recording.read_first_frame``), taken over instead of being
            reconstructed again.
        energy: counters to read around every frame; their joules stand in its metrics.
        witness: called with every step once its packet is written.
        span: frames to encode, by default all; the first of them is the key packet that the stream begins with.
    """
    parts = within_memory(parts, source.info)
    with _one_torch_thread():
        return _Run(parts, source, out, quiet, measure, first_frame, energy, witness, span).encode(resume)


class _Run:
    """The moving parts of one run; lives only inside :func:`run`."""

    def __init__(
        self, parts: Assembly, source: FrameSource, out: Path, quiet: bool, measure: bool,
        first_frame: PlayerState | None, energy: EnergyMeter | None, witness: Witness | None, span: range | None,
    ) -> None:  # fmt: skip
        self.parts, self.source, self.out, self.first_frame = parts, source, out, first_frame
        self.energy, self.witness = energy, witness
        self.rng = Rng(parts.recipe.seed)
        self.controller = Controller(parts.recipe.budget, parts.recipe.stream)
        self.near = parts.recipe.near * source.info.train.extent
        self.start = 0 if span is None else span.start
        self.total = _num_frames(source.info, parts.recipe.frames, None if span is None else span.stop)
        self.held_out = HeldOut(parts.renderer, parts.recipe.background) if measure else None
        self.progress = RunProgress(self.total, quiet)
        self.tools = WholeTools(
            parts, source, self.rng, self.near, lambda frame: self._meta(frame.cameras), first_frame, self.progress.root
        )

    def encode(self, resume: bool) -> RunResult:
        state = self._resume() if resume else None
        done = self.start if state is None else state.player.frame + 1
        if state is None:
            save_resolved(self.out / RECIPE, self.parts.resolved)
        if done > 0:
            self._remember(done)
        last = None if state is None else state.player.frame
        indices = itertools.count(done) if self.total is None else range(done, self.total)
        fsync = self.parts.recipe.codec.fsync
        with (
            _stop_on_interrupt(self.progress.say, self.source) as stop,
            # Also when resuming finds no complete frame 0: what a kill left of it is cut off, and it starts again.
            StreamWriter.open(self.out / STREAM, resume=resume, last_frame=last, fsync=fsync) as writer,
            self.progress,
            Prefetcher(self.source, indices, storage=self.parts.recipe.data.images) as frames,
        ):
            for train, test, waited in _timed(frames):
                state = self._advance(writer, state, self._with_near(train), self._with_near(test), waited)
                done = train.index + 1
                if stop.is_set():
                    break
        return RunResult(self.out, done, stop.is_set() and (self.total is None or done < self.total))

    def _advance(self, writer: StreamWriter, state: Any, train: Frame, test: Frame, waited: float) -> Any:
        train.validate()
        joules = self.energy.read() if self.energy else {}
        started, worked = time.perf_counter(), time.process_time()
        clock = CLOCKS[self.parts.recipe.budget.clock]
        began, allowance = clock(), None if state is None else self.controller.allow()
        step = self._first(train) if state is None else self._next(state, train, allowance)
        if self.parts.whole is None:
            step = self._refreshed(step, train, allowance)
        writer.append(step.packet)
        total, cpu, counted = time.perf_counter() - started, time.process_time() - worked, clock() - began
        if self.witness is not None:
            self.witness(step)
        metrics = {**self._metrics(step, train.index, test, total, waited), "cpu_seconds": cpu}
        if self.energy and joules:
            metrics["joules"] = {name: value - joules[name] for name, value in self.energy.read().items()}
        metrics = self.controller.settle(metrics, counted)
        with (self.out / METRICS).open("a", encoding="utf-8") as log:
            log.write(json.dumps(metrics) + "\n")
        self.progress.frame(metrics)
        return step.state

    def _next(self, state: Any, frame: Frame, allowance: Allowance | None) -> Step[Any]:
        if self.parts.whole is not None:
            return step_whole(self.parts.whole, self.tools, state, frame)
        return frame_step(self.parts, state, frame, self.rng, allowance)

    def _refreshed(self, step: Step[Any], frame: Frame, allowance: Allowance | None) -> Step[Any]:
        size = None if allowance is None else allowance.plan.max_bytes
        return refresh(
            self.parts, step, frame, self._meta, self.rng, lambda n: self.controller.key_refusal(n, allowance), size
        )

    def _first(self, frame: Frame) -> Step[Any]:
        points = functools.cache(lambda: self._points(frame))
        if self.parts.pending:
            meta, say = self._meta(frame.cameras), self.progress.say
            self._settled(choose(self.parts, points, frame, meta, self.first_frame, say))
            save_resolved(self.out / RECIPE, self.parts.resolved)
            for line in lines(self.parts):
                self.progress.say(line)
        if self.parts.whole is not None:
            return begin_whole(self.parts.whole, self.tools, frame)
        if self.first_frame is not None:
            return begin_from(self.parts, self.first_frame, frame, self._meta(frame.cameras), self.rng)
        return begin(self.parts, points(), frame, self._meta(frame.cameras), self.rng, self.progress.root)

    def _points(self, frame: Frame) -> PointCloud:
        """What frame 0 starts from: seeds, or the centres of the Gaussians that are taken over."""
        if self.first_frame is not None:
            return cloud_of(self.first_frame)
        recipe = self.parts.recipe
        seen = with_test_views(self.source, frame) if recipe.data.leak == "points" else frame
        return gather_points(self.source, seen, recipe.first_frame, self.rng)

    def _settled(self, parts: Assembly) -> None:
        """Go on with the values that the scene decided."""
        self.parts, self.tools = parts, replace(self.tools, parts=parts)

    def _metrics(self, step: Step[Any], index: int, test: Frame, total: float, waited: float) -> dict[str, Any]:
        metrics: dict[str, Any] = {"frame": index, "status": step.status, **step.metrics}
        known = sum(metrics["seconds"].values())
        metrics["seconds"] = {**metrics["seconds"], "other": max(0.0, total - known)}
        metrics["wait_seconds"] = waited
        if self.held_out and len(test.cameras):
            metrics |= self.held_out.measure(step.state, test)
        metrics["peak_memory_mb"] = peak_memory_mb()
        if index == 0:
            metrics |= record(self.parts)
        return metrics

    def _meta(self, train: Cameras) -> StreamMeta:
        info, recipe = self.source.info, self.parts.recipe
        distributions = {"gsstream", *self.parts.distributions}
        return StreamMeta(
            method=recipe.method,
            source=info.name,
            recipe=recipe.model_dump(mode="json"),
            train=train,
            test=replace(info.test, near=self.near),
            fps=info.fps,
            background=recipe.background,
            plugins={name: version(name) for name in sorted(distributions)},
            extra={"source_uri": info.uri, "licence": info.licence, **record(self.parts)},
        )

    def _with_near(self, frame: Frame) -> Frame:
        return replace(frame, cameras=replace(frame.cameras, near=self.near))

    def _resume(self) -> MethodState | None:
        if (extra := stream_extra(self.out / STREAM)) is not None:
            self._settled(recall(self.parts, extra))
        planned = self.controller.budget.limits_frames
        # The controller plans by what it wrote down: frames that are not, are made again.
        state = self._last_state(self.out / STREAM, last_written(self.out / METRICS) if planned else None)
        self.controller.remember(trim_metrics(self.out / METRICS, -1 if state is None else state.player.frame))
        if state is None and planned:
            (self.out / STREAM).unlink()
        return state

    def _remember(self, done: int) -> None:
        """What the frames before ``done``, which are not made here, say about noise and about what moves."""
        if self.held_out and len(self.source.info.test):
            second = self.source.frame(1, "test") if done > 1 else None
            self.held_out.remember(self.source.frame(0, "test"), second)

    def _last_state(self, stream: Path, last: int | None) -> MethodState | None:
        if self.parts.whole is not None:
            return resume_whole(self.parts.whole, self.tools, stream)
        return resume_state(self.parts, stream, self.source, self.rng, self.near, last)


@contextmanager
def _one_torch_thread() -> Iterator[None]:
    """Torch's share of a frame is elementwise work on few rows: more threads cost more than they give, and spin against
    the native kernels' own pool. One thread also keeps its sums, and so the bytes, independent of the machine's cores.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _num_frames(info: SourceInfo, *wanted: int | None) -> int | None:
    """None: until a growing recording ends."""
    return min((number for number in (info.num_frames, *wanted) if number is not None), default=None)


def _timed(frames: Prefetcher) -> Iterator[tuple[Frame, Frame, float]]:
    """(train, test, seconds waited for decoding) of every frame."""
    while True:
        started = time.perf_counter()
        try:
            train, test = next(frames)
        except StopIteration:
            return
        yield train, test, time.perf_counter() - started


@contextmanager
def _stop_on_interrupt(say: Callable[[str], None], source: FrameSource) -> Iterator[threading.Event]:
    """First Ctrl-C: finish the frame in flight. Second: stop at once (the stream stays valid up to the last packet)."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def handler(*_: object) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()
        if isinstance(source, GrowingSource):
            source.interrupt()  # the frame in flight may be one that nobody has captured yet
        say("stopping after this frame; interrupt again to stop at once")

    previous = signal.signal(signal.SIGINT, handler)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, previous)
