"""Work for the workers of segment tests: importable by name, so that a process of its own can do it."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

from gsstream.core.frame import Frame
from gsstream.engine.run.encoder import Encoder
from gsstream.trade.segments.job import SegmentJob, SegmentOutcome, run_segment

#: The frame in which a worker is killed, once.
FATAL = 4


def run_and_die_once(job: SegmentJob) -> SegmentOutcome:
    """Encode a segment; the first to step to frame 4 dies there, as if killed from outside. Steps leave marks."""
    marks = Path(os.environ["SEGMENT_TEST_MARKS"])
    encode = Encoder.encode

    def watched(encoder: Encoder, frame: Frame) -> Any:
        if encoder.state is None:
            return encode(encoder, frame)
        marks.joinpath(f"{job.id}-{frame.index}-{os.getpid()}").touch()
        if job.id.startswith("segment") and frame.index == FATAL and not (marks / "dead").exists():
            (marks / "dead").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return encode(encoder, frame)

    Encoder.encode = watched  # type: ignore[method-assign]
    return run_segment(job)
