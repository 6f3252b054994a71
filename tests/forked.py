"""The command line in a process of its own that need not import torch again: most of what such a process costs.

A fork server has imported what every run imports and nothing of any plugin; each command is a copy of it, with a path,
an environment and outputs of its own. What is tested of imports themselves starts an interpreter instead.
"""

from __future__ import annotations

import multiprocessing
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from multiprocessing import forkserver
from pathlib import Path
from typing import Any

PRELOAD = ["gsstream.engine.run.session", "gsstream.evaluation.evaluate", "gsstream.cli.main"]


class Forked:
    """A command at work; what tests use of ``subprocess.Popen``.

    Arguments:
        args: what follows ``gsstream``.
        path: folders in front of those that modules and distributions are looked for in.
        cwd: folder to run in.
        env: the environment; default: this process's.
        first: Python code that runs before the command.
    """

    def __init__(
        self,
        args: Sequence[str],
        *,
        path: Sequence[str] = (),
        cwd: Path | None = None,
        env: Mapping[str, str] | None = None,
        first: str = "",
    ) -> None:
        self.args, self._folder = args, Path(tempfile.mkdtemp())
        self._outputs = [self._folder / name for name in ("out", "err")]
        surroundings = list(path), str(cwd or Path.cwd()), dict(env or os.environ)
        job = (list(args), *surroundings, [str(file) for file in self._outputs], first)
        self._process = _context().Process(target=_serve, args=job)
        self._process.start()
        assert self._process.pid
        self.pid = self._process.pid

    def __enter__(self) -> Forked:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()
        self._process.join()
        shutil.rmtree(self._folder, ignore_errors=True)

    def poll(self) -> int | None:
        """Exit code, negative: the signal that ended it; None while it works."""
        return self._process.exitcode

    @property
    def returncode(self) -> Any:
        """The same."""
        return self.poll()

    def send_signal(self, number: int) -> None:
        """Send a signal to it."""
        os.kill(self.pid, number)

    def kill(self) -> None:
        """End it at once."""
        self._process.kill()

    def communicate(self, timeout: float = 900) -> tuple[str, str]:
        """Wait for its end; stdout and stderr."""
        self._process.join(timeout)
        if self.poll() is None:
            self.kill()
            raise TimeoutError(f"gsstream {' '.join(self.args)}")
        out, err = (file.read_text(encoding="utf-8") for file in self._outputs)
        shutil.rmtree(self._folder)
        return out, err


def gsstream(args: Sequence[str], **surroundings: Any) -> subprocess.CompletedProcess[str]:
    """Run a command to its end, with the arguments of :class:`Forked`; exit code, stdout and stderr."""
    with Forked(args, **surroundings) as process:
        out, err = process.communicate()
        return subprocess.CompletedProcess(["gsstream", *args], process.returncode, out, err)


def _context() -> multiprocessing.context.ForkServerContext:
    """The fork server, which is started by the first command."""
    context = multiprocessing.get_context("forkserver")
    if not forkserver._forkserver._forkserver_pid:  # type: ignore[attr-defined]  # one that runs keeps what it has
        context.set_forkserver_preload(PRELOAD)
        with_threads = {name: os.environ.get(name) for name in ("OMP_NUM_THREADS", "GSSTREAM_THREADS")}
        os.environ |= dict.fromkeys(with_threads, "1")  # a copy of a process with threads may hang
        try:
            forkserver.ensure_running()
        finally:
            for name, value in with_threads.items():
                os.environ.pop(name)
                os.environ |= {} if value is None else {name: value}
    return context


def _serve(args: list[str], path: list[str], cwd: str, env: dict[str, str], outputs: list[str], first: str) -> None:
    """The body of the process."""
    for number, file in enumerate(outputs, 1):
        os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT), number)
    sys.stdout, sys.stderr = (os.fdopen(number, "w", encoding="utf-8", closefd=False) for number in (1, 2))
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(env)
    sys.path[:0] = path
    exec(first, {})
    from gsstream.cli.main import main

    main(args)
