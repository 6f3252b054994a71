"""What workers of a batch do in these tests instead of a run."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from gsstream_lab.batch.work import BatchJob, BatchOutcome, run_batch_job

FACTS = {"recipe": "r", "frames": 2, "bytes": 4000, "psnr": 30.0, "seconds": 1.0, "peak_mb": 100.0}


def make(job: BatchJob) -> BatchOutcome:
    """A result at once."""
    return BatchOutcome(job.id, FACTS, {f"{job.folder}/job.json": b"{}"})


def die_once(job: BatchJob) -> BatchOutcome:
    """Killed at the first attempt of every job, as by the system when memory runs out."""
    mark = Path(os.environ["BATCH_TEST_MARKS"]) / job.id
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return run_batch_job(job)


def wait_then_run(job: BatchJob) -> BatchOutcome:
    """A run that begins when the test says so."""
    marks = Path(os.environ["BATCH_TEST_MARKS"])
    (marks / f"begun-{job.id}").touch()
    while not (marks / "go").exists():
        time.sleep(0.05)
    return run_batch_job(job)
