"""A run: a recording, encoded into a folder, with metrics. Ends cleanly after the current frame on Ctrl-C."""

from __future__ import annotations

import itertools
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Any

from gsstream.core.frame import Frame, PointCloud
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.budget.memory import limit_memory
from gsstream.engine.frame0.points import gather_points, with_test_views
from gsstream.engine.run.blank import BlankCameras, BlankStart, start_numbers
from gsstream.engine.run.displacement import displacement_pixels
from gsstream.engine.run.encoder import Callbacks, EncodedFrame, Encoder
from gsstream.engine.run.few_cameras import expectation, first_frame_summary
from gsstream.engine.run.live import live_metrics, past_moments
from gsstream.engine.run.measure import HeldOut
from gsstream.engine.run.measured_again import measure_again
from gsstream.engine.run.metrics_log import add_metrics, append_metrics, last_written, trim_metrics, written_lines
from gsstream.engine.run.output import is_finalising, write_whole
from gsstream.engine.run.progress import RunProgress
from gsstream.engine.run.same_pictures import PICTURES, KnownPictures, sums
from gsstream.input.recordings.base import Moment, Source, SourceInfo
from gsstream.input.recordings.origin import RECORDING, whole_uri
from gsstream.input.recordings.prefetch import Prefetcher
from gsstream.packet import EncodedPacket, PlayerState, StreamReader, StreamWriter
from gsstream.packet.base import FILE_HEADER
from gsstream.recipe.save import save_resolved

STREAM, METRICS, RECIPE = "stream.gss", "metrics.jsonl", "recipe.yaml"


class RunListener:
    """Told of every frame of a run; does nothing unless a subclass says otherwise."""

    def before(self) -> None:
        """Start a measurement: the images of a frame are in memory, and the frame is encoded next."""

    def after(self, step: EncodedFrame) -> Mapping[str, Any]:
        """Return further entries of the frame's line of metrics; the packet of the frame is written already."""
        return {}


@dataclass(frozen=True)
class RunResult:
    """Where a run ended: folder, frames written in total, and whether Ctrl-C ended it early."""

    out: Path
    frames: int
    interrupted: bool


def run(
    assembly: Assembly,
    source: Source,
    out: Path,
    *,
    resume: bool = False,
    quiet: bool = False,
    measure: bool = True,
    first_frame: PlayerState | None = None,
    listener: RunListener | None = None,
) -> RunResult:
    """Encode a recording into ``out`` (stream.gss, metrics.jsonl, recipe.yaml, recording.txt).

    Arguments:
        assembly: the live parts of the recipe.
        source: an open recording at the recipe's scale; the caller closes it.
        out: a prepared output folder.
        resume: continue the run that ``out`` holds; the recipe must be the same.
        quiet: show no progress.
        measure: render and compare the test cameras of every frame.
        first_frame: frame 0 of another stream, taken over instead of being reconstructed.
        listener: called before and after every frame.
    """
    state = _Run(
        assembly=limit_memory(assembly, source),
        source=source,
        out=out,
        quiet=quiet,
        measure=measure,
        first_frame=first_frame,
    )
    listener, done = listener or RunListener(), state.prepare(resume)
    indices = itertools.count(done) if state.total is None else range(done, state.total)
    with (
        _stop_on_interrupt(state.progress.say, source, lambda: done > 0 or state.written > 0) as stop,
        # This is also the way when resuming finds no complete frame 0: the incomplete one is cut off and made again.
        StreamWriter.open(out / STREAM, resume=resume, last_frame=done - 1 if done else None) as state.writer,
        state.progress,
        Prefetcher(source, indices, pack=True) as frames,
    ):
        for train, test, waited in _timed(frames, source):
            listener.before()
            step = state.encoder.encode(train)
            state.record(step, train, test, {**listener.after(step), "wait_seconds": waited})
            done = train.index + 1
            if stop.is_set():
                break
    return RunResult(out, done, stop.is_set() and (state.total is None or done < state.total))


class _Run:
    """The moving parts of one run; lives only inside :func:`run`."""

    def __init__(
        self,
        assembly: Assembly,
        source: Source,
        out: Path,
        quiet: bool,
        measure: bool,
        first_frame: PlayerState | None,
    ) -> None:
        self.source, self.out = source, out
        self.total = _num_frames(source.info, assembly.recipe.frames)
        self.held_out = HeldOut(assembly.renderer) if measure else None
        self.progress, self.blank = RunProgress(self.total, quiet), (BlankStart(), BlankCameras())
        listeners = Callbacks(packet=self._write, progress=self.progress.first_frame)
        self.encoder = Encoder(assembly, source.info, self._seeds, first_frame=first_frame, callbacks=listeners)
        self.writer: StreamWriter
        #: Where the seeds of frame 0 came from; empty where it is taken over or was made before.
        self.seeded = ""
        #: When the last packet was complete in the file, seconds since 1970.
        self.written = 0.0

    def prepare(self, resume: bool) -> int:
        """Resume the stream in the folder, or write the recipe of a new one; return the first frame to encode."""
        last = self._resume() if resume else None
        # Also of a run that goes on: the recording may lie elsewhere by then.
        write_whole(self.out / RECORDING, os.fsencode(whole_uri(self.source.info.uri) + "\n"))
        if last is None:
            # Made before the first packet: without this file, nobody could tell that the line of the packet is missing.
            (self.out / METRICS).touch()
            save_resolved(self.out / RECIPE, self.encoder.assembly.resolved)
            if sentence := expectation(self.source.info.train):
                self.progress.say(sentence)
            return 0
        self._restore_metrics(last + 1)
        return last + 1

    def record(self, step: EncodedFrame, train: Frame, test: Frame, numbers: Mapping[str, Any]) -> None:
        """Write the cost and the quality of a frame to the metrics file."""
        metrics = {**step.metrics, **numbers, "live": live_metrics(train, self.written)}
        metrics["displacement_pixels"] = displacement_pixels(step.state.player, train.cameras)
        metrics |= {**start_numbers(train), PICTURES: sums(train)}
        for sentence in filter(None, (watcher.look(train) for watcher in self.blank)):
            warnings.warn(sentence, stacklevel=2)
        # A run that is behind does not spend time on the quality of frames that it drops: ``evaluate`` measures it.
        dropped = metrics["live"] is not None and metrics["live"]["policy"] == "dropped"
        if self.held_out and len(test.cameras) and not dropped:
            metrics |= self.held_out.measure(step.state.player, self.encoder.with_near_plane(test))
            if sentence := self.held_out.out_of_light(test.index):
                warnings.warn(sentence, stacklevel=2)
            if train.index == 0:
                doubt = self.held_out.doubt(step.state.player, self.encoder.with_near_plane(train), metrics["psnr"])
                if doubt:
                    warnings.warn(f"{doubt}: see 'gsstream scene validate {self.source.info.uri}'", stacklevel=2)
        append_metrics(self.out / METRICS, metrics)
        self.progress.frame(metrics)
        if train.index == 0 and self.seeded:
            self.progress.say(first_frame_summary(self.encoder.assembly, train.cameras, self.seeded))

    def _write(self, packet: EncodedPacket) -> None:
        self.writer.append(packet)
        # The clock of files, not a monotonic one: images are dated by it.
        self.written = time.time()

    def _seeds(self, frame: Frame) -> PointCloud:
        recipe, device = self.encoder.assembly.recipe, self.encoder.assembly.renderer.device
        seen = with_test_views(self.source, frame) if recipe.data.leak == "points" else frame
        points = gather_points(self.source, seen, recipe.first_frame, self.progress.tell, device=device)
        self.seeded = points.origin
        return points

    def _resume(self) -> int | None:
        """Resume the stream in the folder; return its last frame, or None when the stream begins anew."""
        stream, log = self.out / STREAM, self.out / METRICS
        planned = self.encoder.assembly.recipe.budget.limits_frames
        # A kill between a packet and its line leaves a frame that no table would count, and that a budget would plan
        # without. A later frame is encoded again, to the same bytes: it costs little, and its line tells everything.
        # Frame 0 may cost as much as all later frames together, and where the whole log is gone the run would be
        # encoded twice: in both cases packets are kept and measured again.
        wanted: int | None = last_written(log)
        if not planned and wanted == -1:
            wanted = None
        lines = written_lines(log)
        past, known = past_moments(lines), KnownPictures(lines)
        last = self.encoder.resume(stream, lambda index: known.looked_at(self._encoded(past, index)), wanted)
        if last is not None:
            known.check(str(self.encoder.state.player.meta.extra.get("source_uri", "")), self.source.info.uri)
        if wanted is not None:
            _warn_lost_lines(stream, -1 if last is None else last)
        kept = trim_metrics(log, -1 if last is None else last)
        if last is not None:
            self.source.go_on_at(last + 1, past)
        if self.encoder.controller is not None:
            self.encoder.controller.remember(kept)
        if last is None and wanted is not None:
            stream.unlink()  # the file may hold sound packets of frames that are made again
        if last is not None and wanted is None:
            self._measure_again(kept, last)
        return last

    def _encoded(self, past: Mapping[int, Moment], index: int) -> Frame:
        """A frame that this run has encoded, as it came in then."""
        self.source.go_on_at(index + 1, past)
        frame = self.source.frame(index, "train")
        came = past.get(index)
        return frame if came is None else replace(frame, epoch_scale=came.epoch_scale, arrival=came.arrival)

    def _measure_again(self, kept: list[dict[str, Any]], last: int) -> None:
        """Write the lines that the packets up to ``last`` lack."""
        known = {int(line["frame"]) for line in kept}
        missing = [frame for frame in range(last + 1) if frame not in known]
        warnings.warn(
            f"{METRICS} has no line of {_frames(missing)}, though {STREAM} has the packets: the decoded frames are "
            "measured again; what they cost is lost",
            stacklevel=2,
        )
        self._restore_metrics(last + 1)
        lines = measure_again(self.out / STREAM, missing, self.source, encoder=self.encoder, held_out=self.held_out)
        add_metrics(self.out / METRICS, kept, lines)

    def _restore_metrics(self, done: int) -> None:
        """Noise and moving pixels of the frames before ``done``, which this session does not encode."""
        if self.held_out and len(self.source.info.test):
            second = self.source.frame(1, "test") if done > 1 else None
            self.held_out.remember(self.source.frame(0, "test"), second)


def _warn_lost_lines(stream: Path, last: int) -> None:
    """Warn of packets whose lines a kill has lost: they are made again, and it may be for hours."""
    if stream.stat().st_size < FILE_HEADER.size:
        return
    with StreamReader(stream) as reader:
        held = [entry.frame for entry in reader.frames if entry.frame > last]
    if held:
        warnings.warn(
            f"{METRICS} has no line of frame {held[0]}, though {stream.name} has its packet: {_frames(held)} of the "
            f"stream {'is' if len(held) == 1 else 'are'} made again",
            stacklevel=2,
        )


def _frames(indices: Sequence[int]) -> str:
    """Name frames in the order of their indices."""
    return f"frame {indices[0]}" if len(indices) == 1 else f"frames {indices[0]} to {indices[-1]}"


def _num_frames(info: SourceInfo, wanted: int | None) -> int | None:
    """None: until a growing recording ends."""
    return min((number for number in (info.num_frames, wanted) if number is not None), default=None)


def _timed(frames: Prefetcher, source: Source) -> Iterator[tuple[Frame, Frame, float]]:
    """(train, test, seconds waited) of every frame; the source is asked again for the epoch scale of live ones."""
    while True:
        started = time.perf_counter()
        try:
            train, test = next(frames)
        except StopIteration:
            return
        waited = time.perf_counter() - started
        if train.arrival is not None:
            worth = min(train.epoch_scale, source.epoch_scale(train.index))
            arrival = replace(train.arrival, waiting=source.waiting(train.index))
            train = replace(train, epoch_scale=worth, arrival=arrival)
        yield train, test, waited


@contextmanager
def _stop_on_interrupt(
    say: Callable[[str], None], source: Source, begun: Callable[[], bool]
) -> Iterator[threading.Event]:
    """First Ctrl-C: finish the frame in flight. Second: stop at once (the stream stays valid up to the last packet).

    Before there is a packet, which ``begun`` says, the first one stops at once: nothing would be lost.
    """
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def handler(_: int, frame: FrameType | None) -> None:
        source.interrupt()  # the frame in flight may be one that is not captured yet
        if stop.is_set() or not begun():
            if is_finalising(frame):  # what is raised there is printed, and lost: the signal comes once more after it
                threading.Timer(0.01, os.kill, (os.getpid(), signal.SIGINT)).start()
                return
            raise KeyboardInterrupt
        stop.set()
        say("stopping after this frame; interrupt again to stop at once")

    previous = signal.signal(signal.SIGINT, handler)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, previous)
