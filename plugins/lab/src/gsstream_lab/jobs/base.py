"""What an executor is, and what it is given and gives back: the contract of every way to run jobs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

#: Libraries with thread pools of their own read these when they are imported.
_THREAD_VARIABLES = ("GSSTREAM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
#: What a worker does: a job (data with an ``id``) in, its outcome out.
Work = Callable[[Any], Any]


@dataclass(frozen=True, slots=True)
class Finished:
    """A job that is over. ``outcome`` is None when its worker died: ``reason`` says how."""

    id: str
    outcome: Any
    reason: str = ""


class Executor(Protocol):
    """Runs jobs somewhere, several at a time."""

    @property
    def slots(self) -> int:
        """Number of jobs that are handed over at once."""

    def submit(self, job: Any) -> None:
        """Start a job, or queue it."""

    def next(self) -> Finished:
        """Wait until a submitted job is over."""

    def close(self) -> None:
        """End what still runs, at once, and release everything."""


def thread_environment(threads: int) -> dict[str, str]:
    """Return the environment of a worker with this many threads."""
    return dict.fromkeys(_THREAD_VARIABLES, str(threads))
