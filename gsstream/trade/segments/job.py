"""One task as data for a worker, and what it says when it is over."""

from __future__ import annotations

import tempfile
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from gsstream.core.frame import Frame, PointCloud
from gsstream.packet import PlayerState
from gsstream.player.playback import Playback
from gsstream.recipe.load import ResolvedRecipe
from gsstream.source.base import FrameSource, PointKind, SourceInfo, Split
from gsstream.trade.segments.plan import STREAM


@dataclass(frozen=True, slots=True)
class SegmentJob:
    """What a worker needs. ``work``: its folder, in which it also goes on; None: a temporary one (another machine).

    Arguments:
        first: a stream whose last frame the first of ``frames`` is taken from; None: it is reconstructed.
        shown: see ``plan.Task``.
        measure: compare decoded frames with the test cameras while encoding.
    """

    id: str
    uri: str
    resolved: ResolvedRecipe
    frames: range
    first: bytes | None = None
    shown: int | None = None
    measure: bool = True
    work: str | None = None


@dataclass(frozen=True, slots=True)
class SegmentOutcome:
    """How it ended: ``error`` is None when it went well. ``files``: what it wrote, where the folder was temporary."""

    id: str
    error: str | None = None
    details: str = ""
    files: tuple[tuple[str, bytes], ...] = ()


def run_segment(job: SegmentJob) -> SegmentOutcome:
    """Encode the frames of a job, or go on where a killed worker stopped; whatever goes wrong is in the outcome."""
    try:
        with _folder(job.work) as folder:
            _encode(job, folder)
            kept = () if job.work else tuple((path.name, path.read_bytes()) for path in sorted(folder.iterdir()))
        return SegmentOutcome(job.id, files=kept)
    except Exception as error:  # the seam to the driver: it says which segment failed, and why
        return SegmentOutcome(job.id, f"{type(error).__name__}: {error}", traceback.format_exc())


@contextmanager
def _folder(work: str | None) -> Iterator[Path]:
    if work is not None:
        Path(work).mkdir(parents=True, exist_ok=True)
        yield Path(work)
        return
    with tempfile.TemporaryDirectory(prefix="segment-") as folder:
        yield Path(folder)


def _encode(job: SegmentJob, folder: Path) -> None:
    from gsstream.engine.assembly.assemble import assemble
    from gsstream.engine.run.recording import open_recording
    from gsstream.engine.run.session import run
    from gsstream.plugins.catalog import load_catalog

    catalog = load_catalog()
    parts = assemble(job.resolved, catalog)
    first = None if job.first is None else _last_frame(job.first, folder)
    recording = open_recording(job.uri, parts.recipe, catalog)
    source = recording if job.shown is None else Carried(recording, job.frames.start, job.shown)
    try:
        run(
            parts, source, folder, resume=(folder / STREAM).exists(), quiet=True, measure=job.measure,
            first_frame=first, span=job.frames,
        )  # fmt: skip
    finally:
        recording.close()


def _last_frame(stream: bytes, folder: Path) -> PlayerState:
    """The decoded last frame of a stream."""
    path = folder / "first.gss"
    path.write_bytes(stream)
    try:
        with Playback(path) as playback:
            return playback.player_state(playback.frames[-1])
    finally:
        path.unlink()


class Carried:
    """A recording in which frame ``place`` shows what frame ``shown`` showed: the step to the next frame is a leap."""

    def __init__(self, source: FrameSource, place: int, shown: int) -> None:
        self._source, self._place, self._shown = source, place, shown

    @property
    def info(self) -> SourceInfo:
        return self._source.info

    def frame(self, index: int, split: Split = "train") -> Frame:
        """Read one instant."""
        if index != self._place:
            return self._source.frame(index, split)
        return replace(self._source.frame(self._shown, split), index=index, timestamp=index / self.info.fps)

    def points(self, kind: PointKind = "recording") -> PointCloud | None:
        """Return points of frame 0."""
        return self._source.points(kind)

    def close(self) -> None:
        """Close the recording."""
        self._source.close()
