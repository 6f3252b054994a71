"""The command line in a process of its own that need not import torch again: most of what such a process costs.

A fork server has imported what every run imports and nothing of any plugin; each command is a copy of it, with a path,
an environment and outputs of its own. What is tested of imports themselves starts an interpreter instead.
"""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from multiprocessing import forkserver
from pathlib import Path

PRELOAD = ["gsstream.engine.run.session", "gsstream.evaluation.evaluate", "gsstream.cli.main"]


def gsstream(
    args: Sequence[str], *, path: Sequence[str] = (), cwd: Path | None = None, env: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run ``gsstream ARGS`` to its end.

    Arguments:
        path: folders in front of those that modules and distributions are looked for in.
        cwd: folder to run in.
        env: the environment; default: this process's.

    Returns exit code (negative: the signal that ended it), stdout and stderr.
    """
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
    with tempfile.TemporaryDirectory() as folder:
        outputs = [Path(folder) / name for name in ("out", "err")]
        job = (list(args), list(path), str(cwd or Path.cwd()), dict(env or os.environ), [str(file) for file in outputs])
        process = context.Process(target=_serve, args=job)
        process.start()
        process.join(900)
        if process.exitcode is None:
            process.kill()
            raise TimeoutError(f"gsstream {' '.join(args)}")
        out, err = (file.read_text(encoding="utf-8") for file in outputs)
    return subprocess.CompletedProcess(["gsstream", *args], process.exitcode, out, err)


def _serve(args: list[str], path: list[str], cwd: str, env: dict[str, str], outputs: list[str]) -> None:
    """The body of the process."""
    for number, file in enumerate(outputs, 1):
        os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT), number)
    sys.stdout, sys.stderr = (os.fdopen(number, "w", encoding="utf-8", closefd=False) for number in (1, 2))
    os.chdir(cwd)
    os.environ.clear()
    os.environ.update(env)
    sys.path[:0] = path
    from gsstream.cli.main import main

    main(args)
