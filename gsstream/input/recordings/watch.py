"""A recording that is still being written: follow a folder of images, frame by frame, until its end is clear."""

from __future__ import annotations

import threading
import time
import warnings
from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gsstream.core.errors import EndOfRecording, SourceError
from gsstream.core.frame import Arrival, PointCloud
from gsstream.core.storage import packed
from gsstream.input.recordings.backlog import Backlog
from gsstream.input.recordings.base import CameraSource, Moment, PointKind, SourceInfo
from gsstream.input.recordings.calibration import CALIBRATION_FILE, Calibration, is_video, read_calibration
from gsstream.input.recordings.depth_maps import FOLDER
from gsstream.input.recordings.images import read_stored, scaled_size
from gsstream.input.recordings.numbering import Numbering
from gsstream.input.recordings.options import WatchOptions, options_of_query
from gsstream.input.recordings.pointfiles import POINTS_FILE, read_points


@dataclass(frozen=True, slots=True)
class _Plan:
    """What is delivered as one frame: ``epoch_scale``, and from which earlier frame cameras are held.

    ``skipped``: the run is behind; its files are not read, and the last images of all cameras stand in.
    """

    epoch_scale: float = 1.0
    held: tuple[tuple[str, int], ...] = ()
    skipped: bool = False


_WHOLE = _Plan()


class WatchSource(CameraSource):
    """Frames of a growing folder in the layout of cameras.json. ``frame`` waits until the frame is there.

    EndOfRecording is raised where the recording ended before it. Test cameras are left out of a frame in which one of
    them is absent, so that nothing is measured against an image of another time.
    A frame once delivered never changes: a file that is written again later is not read again. ``info.uri`` is the
    folder: streams name the recording, not how it was followed. Raises SourceError for a faulty calibration.
    """

    def __init__(self, folder: Path, options: WatchOptions, *, scale: float = 1.0) -> None:
        self._folder, self._options = folder, options
        calibration = read_calibration(folder, growing=True)
        _check_patterns(folder, calibration)
        self._native = (calibration.train.width, calibration.train.height)
        self._target = scaled_size(self._native, scale)
        self._ids = (*calibration.train.ids, *calibration.test.ids)
        self._train = frozenset(calibration.train.ids)
        declared = calibration.num_frames or None
        self._info = SourceInfo(
            name=calibration.name,
            uri=str(folder),
            num_frames=declared,
            fps=calibration.fps,
            train=calibration.train.scaled(*self._target),
            test=calibration.test.scaled(*self._target),
            licence=calibration.licence,
            depth_maps=folder / FOLDER,
        )
        self._plans: dict[int, _Plan] = {}  # only frames that are not delivered whole
        self._next, self._ahead = 0, 0
        self._numbers = Numbering(folder, calibration.patterns)
        self._backlog = Backlog(self._path, self._train, declared, options)
        self._decoded: dict[tuple[str, int], Any] = {}  # of the frame that is waited for
        self._faults: dict[str, str] = {}
        self._last: dict[str, int] = {}
        self._stop, self._planning = threading.Event(), threading.Lock()

    @classmethod
    def from_query(cls, rest: str, *, scale: float = 1.0) -> WatchSource:
        """Build from ``"DIR?timeout=10&behind=drop"``. Raises SourceError naming an unknown or impossible option."""
        folder, _, query = rest.partition("?")
        if not folder:
            raise SourceError("watch source: expected watch:DIR or watch:DIR?key=value&..., got no folder")
        return cls(Path(folder), options_of_query(WatchOptions, query, "watch source"), scale=scale)

    @property
    def info(self) -> SourceInfo:
        """What is known so far: ``num_frames`` is None until it is declared or the end has been seen."""
        return self._info

    def stored_image(self, index: int, camera: str) -> Any:
        """Wait for one instant and read one camera's image as it is stored, or its last one where it is absent."""
        shown = dict(self._plan(index).held).get(camera, index)
        # The image as it was decoded to see whether it is whole; where it is no longer held, it is read again.
        ready = self._decoded.get((camera, shown))
        return self._read(camera, shown) if ready is None else ready

    @property
    def stores_bytes(self) -> bool:
        """Whether images are read at their size; those still to come are taken for 8-bit ones, as nearly all are."""
        return self._target == self._native

    def moment(self, index: int) -> Moment:
        """Wait for one instant and return how it came in."""
        plan = self._plan(index)
        held = dict(plan.held)
        return Moment(plan.epoch_scale, self._arrival(index, () if plan.skipped else held), tuple(held))

    def epoch_scale(self, index: int) -> float:
        """Return what a frame is worth now that its turn has come: more may wait than when it was read ahead."""
        return 1.0 if index == 0 else min(self._plan(index).epoch_scale, self._backlog.effort(index))

    def waiting(self, index: int) -> int:
        """Return how many frames after this one have come of all training cameras."""
        return self._backlog.behind(index)

    def go_on_at(self, index: int, past: Mapping[int, Moment]) -> None:
        """Plan the frames before this one as ``past`` has them, and those that it lacks by the files that are there."""
        with self._planning:
            for done in range(self._next, index):
                self._plan_done(done, past.get(done, Moment()))

    def points(self, kind: PointKind = "recording") -> PointCloud | None:
        """Return points that were written beside cameras.json before the run began, or None."""
        path = self._folder / POINTS_FILE
        return read_points(path, kind) if path.exists() else None

    def interrupt(self) -> None:
        """End all waits: frames that are not there yet raise EndOfRecording from now on."""
        self._stop.set()

    def close(self) -> None:
        """End all waits; nothing stays open between reads."""
        self.interrupt()

    def _arrival(self, index: int, held: Collection[str]) -> Arrival:
        """How a frame arrived, and when: the frame waits for its test cameras, so they count, too."""
        came = self._newest_of(set(self._ids).difference(held), index)
        return Arrival(came, tuple(name for name in self._info.train.ids if name in held))

    def _read(self, camera_id: str, index: int) -> Any:
        return packed(read_stored(self._path(camera_id, index), self._native, self._target))

    def _path(self, camera_id: str, index: int) -> Path:
        return self._numbers.path(camera_id, index)

    def _plan(self, index: int) -> _Plan:
        """Return the plan of a frame, which is made once and kept. Raises EndOfRecording where there is no frame."""
        if index < 0:
            raise SourceError(f"recording {self._info.name!r} has no frame {index}; frames are counted from 0")
        if index >= self._next:
            with self._planning:
                while self._next <= index:
                    self._keep(self._decide(self._next))
        return self._plans.get(index, _WHOLE)

    def _keep(self, plan: _Plan) -> None:
        """Write down the plan of the next frame."""
        if plan != _WHOLE:
            before = self._plans.get(self._next - 1)
            self._plans[self._next] = before if before == plan else plan
        if not plan.skipped:
            self._last |= dict.fromkeys(set(self._ids) - {name for name, _ in plan.held}, self._next)
        self._next += 1

    def _plan_done(self, index: int, came: Moment) -> None:
        """Plan a frame that another run has encoded, without a wait."""
        self._numbers.begin(index)
        if not any(self._path(name, index).exists() for name in self._ids):
            self._numbers.left_out(index, over=True)
        lost = () if came.arrival is None else came.arrival.absent
        skipped = index > 0 and came.epoch_scale == 0 and not lost
        there = {name for name in self._ids if name not in lost and self._path(name, index).exists()}
        held = [name for name in self._ids if (skipped or name not in there) and name in self._last]
        self._keep(_Plan(came.epoch_scale, tuple((name, self._last[name]) for name in held), skipped=skipped))

    def _decide(self, index: int) -> _Plan:
        if self._info.num_frames is not None and index >= self._info.num_frames:
            raise EndOfRecording(f"the recording ended after {self._info.num_frames} frames")
        if 0 < index < self._backlog.skip_to:  # images of all training cameras came, and newer ones
            return _Plan(0.0, tuple((name, self._last[name]) for name in self._ids), skipped=True)
        absent = self._wait(index)
        self._backlog.gone = frozenset(absent)
        untrained = [name for name in absent if name in self._train]
        held = tuple((name, self._last[name]) for name in absent)
        if untrained and self._options.missing == "drop":
            return _Plan(0.0, held)
        return _Plan(self._backlog.effort(index), held)

    def _wait(self, index: int) -> list[str]:
        """Wait until every camera's image is there and whole, or the policy gives up; the cameras that are absent."""
        seen: dict[str, tuple[int, int]] = {}
        whole: set[str] = set()
        stepped = self._numbers.begin(index)
        pause = self._options.poll if stepped else max(self._options.grace, 1.0)  # between looks at whole folders
        due = 0.0 if stepped else pause
        self._decoded, self._faults = {}, {}
        changed = began = came = time.monotonic()
        given_up: list[str] = []
        while True:
            ended = (self._folder / self._options.end).exists()
            before = dict(seen)
            open_names = [name for name in self._ids if name not in whole]
            settled = [name for name in open_names if self._settled(name, index, seen, changed=changed, ended=ended)]
            decoded = {name for name in settled if self._decodes(name, index)}
            came = time.monotonic() if decoded else came
            whole |= decoded
            absent = [name for name in self._ids if name not in whole]
            if not absent:
                return []
            now = time.monotonic()
            changed = now if seen != before else changed
            over = ended or now - changed >= self._options.timeout
            if not seen and (over or now - began >= due):
                due += pause
                if self._numbers.left_out(index, over):
                    changed = now
                    continue
            if self._give_up(index, absent, whole, waited=now - came, over=over):
                if absent == given_up:
                    return absent
                given_up = absent  # the folder is looked at once more: an image may have come during the last look
                continue
            if over or self._stop.is_set():
                self._end(index, absent, ended)
            self._stop.wait(self._options.poll)

    def _settled(self, name: str, index: int, seen: dict[str, tuple[int, int]], changed: float, ended: bool) -> bool:
        """Whether a camera's file counts as written; ``seen`` remembers (size, time of change) of the last look."""
        try:
            state = self._path(name, index).stat()
        except FileNotFoundError:
            return False
        known, seen[name] = seen.get(name), (state.st_size, state.st_mtime_ns)
        if state.st_size == 0:
            return False
        if self._options.ready == "rename" or ended or self._path(name, index + 1).exists():
            return True
        still = known == seen[name] and time.monotonic() - changed >= self._options.settle
        return still or time.time() - state.st_mtime >= self._options.settle

    def _decodes(self, name: str, index: int) -> bool:
        """A writer may stall in the middle of a file; what does not decode is not there yet."""
        try:
            self._decoded[name, index] = self._read(name, index)
        except SourceError as error:
            self._faults[name] = str(error)
            return False
        return True

    def _give_up(self, index: int, absent: list[str], whole: set[str], waited: float, over: bool) -> bool:
        """Whether the absent cameras have had their grace, counted from the newest image of the others.

        ``over``: nothing more comes, so that the frame is made of what is there, unless it is the last and nothing is.
        """
        if self._options.missing == "wait" or index == 0:
            return False
        if over:
            return bool(whole) or self._numbers.goes_on(index)
        if not whole:
            return False
        if all(self._path(name, index + 1).exists() for name in absent):
            return True  # they have moved on: this image will not come
        # Times of files are those of the writer's clock, which may be ahead of ours or behind: they are compared with
        # each other, never with the time here. Who is behind meets frames whose grace was over long ago.
        self._ahead = max(self._ahead, index)
        while any(self._path(name, self._ahead + 1).exists() for name in whole):
            self._ahead += 1
        newest, *later = (self._newest_of(whole, frame) for frame in (index, index + 1, self._ahead))
        passed = 0.0 if newest is None else max((time - newest for time in later if time is not None), default=0.0)
        return max(waited, passed) >= self._options.grace

    def _newest_of(self, names: set[str], index: int) -> float | None:
        """Time of the newest image of a frame, by the writer's clock; None: none of them is there (any more)."""
        times = []
        for name in names:
            with suppress(FileNotFoundError):
                times.append(self._path(name, index).stat().st_mtime)
        return max(times, default=None)

    def _end(self, index: int, absent: list[str], ended: bool) -> None:
        """Nothing more will come: say why when it is not what the writer announced, and raise EndOfRecording."""
        if index == 0 and not self._stop.is_set():
            raise SourceError(
                f"{self._folder}: frame 0 needs every camera{self._lacking(absent)}; start the capture before the run "
                "ends its wait (timeout=), or take the camera out of cameras.json"
            )
        self._info = replace(self._info, num_frames=index)
        partly = len(absent) < len(self._ids)
        reason = f"{self._options.end} was written" if ended else f"nothing came for {self._options.timeout:g} s"
        if not self._stop.is_set() and (partly or not ended):
            lacking = f"; frame {index} is left out{self._lacking(absent)}" if partly else ""
            warnings.warn(f"{self._folder}: the recording ends after {index} frames: {reason}{lacking}", stacklevel=2)
        raise EndOfRecording(f"the recording ended after {index} frames")

    def _lacking(self, absent: list[str]) -> str:
        """The absent cameras in words, with the reason of the first whose file could not be read."""
        fault = next((f": {self._faults[name]}" for name in absent if name in self._faults), "")
        return f" (no whole image of {', '.join(absent)}{fault})"


def _check_patterns(folder: Path, calibration: Calibration) -> None:
    for name, pattern in calibration.patterns.items():
        if "%" not in pattern or is_video(pattern):
            raise SourceError(
                f"{folder / CALIBRATION_FILE}: camera {name!r}: 'frames' {pattern!r} names a single "
                f"{'video' if is_video(pattern) else 'image'}; a growing recording needs a pattern such as %06d"
            )
    for name in calibration.lenses:
        raise SourceError(
            f"{folder / CALIBRATION_FILE}: camera {name!r} has 'distortion'; a growing recording needs pictures of a "
            "pinhole: undistort them as they come"
        )
