"""What workers do in these tests instead of a run: seconds matter, and a death must come when it is wanted."""

from __future__ import annotations

import contextlib
import io
import os
import signal
import sys
import time
import warnings
from pathlib import Path

from gsstream_lab.sweep.job import Job, Outcome, run_job

TWO_SEEDS = """
name: two
scenes: [{name: world, uri: "synthetic:frames=2"}]
seeds: [0, 1]
variants: [{name: dense, method: dense}]
axes: {stream.epochs: [1, 2]}
"""
#: Small enough to be encoded in a test.
REAL = """
name: real
scenes: [{name: world, uri: "synthetic:frames=3&views=3&width=64&height=48&supersample=1", frames: 2}]
set: {first_frame: {max_iterations: 5, max_points: 200}}
variants: [{name: dense, method: dense}]
axes: {stream.epochs: [1, 2]}
measure: {fps: true}
"""
FRAME = {"frame": 0, "status": "key", "bytes": {"layout": 10}, "seconds": {"code": 0.5}, "num_gaussians": 1}


def make(job: Job) -> Outcome:
    """A result at once; its stream says which frame 0 it was given."""
    recipe, stream = {"seed": job.resolved.recipe.seed}, job.id.encode() + (job.first_frame or b"")
    return Outcome(job.id, (FRAME,), recipe, f"recipe-{job.id}", stream, {"os": "x"})


def die_once(job: Job) -> Outcome:
    """Killed at the first attempt of every job, as by the system when memory runs out."""
    mark = Path(os.environ["SWEEP_TEST_MARKS"]) / job.id
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return make(job)


def die(job: Job) -> Outcome:
    """Never comes back."""
    os._exit(3)


def fail_in_seed_1(job: Job) -> Outcome:
    """A part that cannot do something."""
    if job.resolved.recipe.seed == 1:
        return Outcome(job.id, error="ComponentError: gate 'x' failed", details="Traceback")
    return make(job)


def hang(job: Job) -> Outcome:
    """Says that it works and goes on for longer than any test."""
    Path(os.environ["SWEEP_TEST_MARKS"], f"pid-{os.getpid()}").touch()
    time.sleep(120)
    return make(job)


def hang_then_run(job: Job) -> Outcome:
    """Works until somebody kills it; the second attempt is a real run."""
    mark = Path(os.environ["SWEEP_TEST_MARKS"]) / job.id
    if not mark.exists():
        mark.touch()
        hang(job)
    return run_job(job)


def threads(job: Job) -> Outcome:
    """Tells what the libraries in a worker will see, and what its user sees of a warning."""
    with contextlib.redirect_stderr(io.StringIO()) as said:
        warnings.warn("so many threads", UserWarning, stacklevel=1)
    seen = {name: value for name, value in os.environ.items() if name.endswith("_THREADS")}
    return Outcome(job.id, run={**seen, "said": said.getvalue()})


if __name__ == "__main__":
    # A sweep whose cells hang, as a process of its own: python sweep_works.py CONFIG OUT
    import sweep_works
    from gsstream_lab.jobs.executor import LocalExecutor
    from gsstream_lab.sweep.config import read_sweep
    from gsstream_lab.sweep.drive import run_sweep
    from gsstream_lab.sweep.plan import make_plan

    from gsstream.discovery.catalog import load_catalog

    config = Path(sys.argv[1])
    plan = make_plan(read_sweep(config), config.parent, load_catalog().recipe_path)
    run_sweep(plan, Path(sys.argv[2]), LocalExecutor(2, 1, sweep_works.hang))
