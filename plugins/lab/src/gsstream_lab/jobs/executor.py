"""Executors: here processes on this machine, one for each job; on a cluster those of ``ray_executor``."""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from multiprocessing import forkserver
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

from gsstream.core.processors import processors
from gsstream_lab.jobs.base import Executor, Finished, Work, thread_environment


class LocalExecutor:
    """A fresh process for each job: peak memory is the cell's own, and nothing leaks between cells.

    Where the system can, processes are copied from a fork server that has imported ``preload`` once and has no threads,
    which saves seconds of imports. Elsewhere they are spawned.
    """

    def __init__(self, workers: int, threads: int, work: Work, preload: Sequence[str] = ()) -> None:
        self.slots, self._threads, self._work = workers, threads, work
        self._running: dict[Connection, tuple[str, BaseProcess]] = {}
        methods = multiprocessing.get_all_start_methods()
        self._context: Any = multiprocessing.get_context("forkserver" if "forkserver" in methods else "spawn")
        if "forkserver" in methods:
            self._context.set_forkserver_preload(list(preload))
            with _environment(thread_environment(threads)):  # so that no library starts threads in the server itself
                forkserver.ensure_running()

    def submit(self, job: Any) -> None:
        """Start a process for the job."""
        here, there = self._context.Pipe(duplex=False)
        # A worker inherits the environment that the fork server was started with, so the present one is set here.
        environment = {**os.environ, **thread_environment(self._threads)}
        arguments = (there, self._work, job, environment)
        process = self._context.Process(target=_serve, args=arguments, name=f"cell {job.id}", daemon=True)
        process.start()
        there.close()
        self._running[here] = (job.id, process)

    def next(self) -> Finished:
        """Wait for a process; a closed pipe without an outcome is a death."""
        assert self._running, "next() without a submitted job"
        ready = multiprocessing.connection.wait(list(self._running))[0]
        assert isinstance(ready, Connection)
        key, process = self._running.pop(ready)
        try:
            outcome = ready.recv()
        except EOFError:
            outcome = None
        ready.close()
        process.join()
        return Finished(key, outcome, "" if outcome else _how_it_ended(process.exitcode))

    def close(self) -> None:
        """Kill what runs: a cell that is not finished is made again anyway."""
        for connection, (_, process) in self._running.items():
            process.kill()
            process.join()
            connection.close()
        self._running.clear()


def make_executor(work: Work, workers: int | None, threads: int, ray: str | None = None) -> Executor:
    """Return processes on this machine, or tasks on the Ray cluster at ``ray``.

    Raises what :class:`gsstream_lab.jobs.ray_executor.RayExecutor` raises.
    """
    if ray is not None:
        from gsstream_lab.jobs.ray_executor import RayExecutor

        return RayExecutor(ray, workers, threads, work)
    workers = workers or max(1, processors() // threads)
    return LocalExecutor(workers, threads, work, ["gsstream_lab.jobs.warm"])


def _serve(pipe: Connection, work: Work, job: Any, environment: Mapping[str, str]) -> None:
    """The body of a worker process."""
    os.environ.clear()
    os.environ.update(environment)
    # Ctrl-C reaches the whole group; the sweep decides what becomes of its workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_die_with_parent, daemon=True).start()
    # One line, as the command prints its own warnings: without the path of an installed file.
    warnings.showwarning = lambda message, *_, **__: print(f"warning: {message}", file=sys.stderr)
    pipe.send(work(job))


def _die_with_parent() -> None:
    """A worker whose sweep was killed must not work on: the resumed sweep makes its cell again."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


@contextmanager
def _environment(changes: Mapping[str, str]) -> Iterator[None]:
    before = dict(os.environ)
    os.environ.update(changes)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def _how_it_ended(code: int | None) -> str:
    if code is not None and code < 0:
        name = signal.Signals(-code).name
        return f"the worker process was killed by {name}" + ("; out of memory?" if name == "SIGKILL" else "")
    return f"the worker process ended with code {code} and no result"
