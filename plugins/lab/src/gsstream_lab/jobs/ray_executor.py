"""The same jobs on a Ray cluster (extra: ray). Jobs and outcomes are data, so workers need no shared folder: recordings
lie at an address, or at the same place on every machine."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

from gsstream.core.errors import InputError, PluginUnavailable
from gsstream.core.install_hints import install_extra
from gsstream_lab.jobs.base import Finished, Work, thread_environment

#: What a worker must know of the environment that the sweep was started in.
_PASSED_ON = ("GSSTREAM_LOAD_PLUGINS", "GSSTREAM_ISA")


class RayExecutor:
    """Ray tasks, one worker process for each job (``max_calls=1``); Ray itself repeats nothing, the sweep does.

    ``address``: of a running cluster ("HOST:PORT", "ray://HOST:PORT", "auto"), or "local" to start one here. Raises
    PluginUnavailable without Ray, InputError when there is no cluster at ``address``.
    """

    def __init__(self, address: str, workers: int | None, threads: int, work: Work) -> None:
        self._ray = ray = _import_ray()
        local = address == "local"
        options: dict[str, Any] = {"log_to_driver": False, "logging_level": "warning"}
        if local:
            options |= {"include_dashboard": False, "num_cpus": workers * threads if workers else None}
            # Ray gives its workers a niceness of 15, and this machine is the user's own.
            os.environ.setdefault("RAY_worker_niceness", "0")
        else:
            options["address"] = address
        try:
            ray.init(**options)
        except (ConnectionError, ValueError, TimeoutError, RuntimeError) as error:
            raise InputError(f"--ray {address}: no Ray cluster answers there: {error}; 'local' starts one") from error
        processors = int(ray.cluster_resources().get("CPU", 0))
        if processors < threads:
            ray.shutdown()
            raise InputError(f"--ray {address}: the cluster has {processors} processors, --threads asks for {threads}")
        self.slots = min(workers or processors, processors // threads)
        passed = {name: os.environ[name] for name in _PASSED_ON if name in os.environ}
        environment = {"env_vars": {**thread_environment(threads), **passed}}
        make = ray.remote(num_cpus=threads, max_calls=1, max_retries=0, runtime_env=environment)
        self._remote = make(work)
        self._running: dict[Any, str] = {}
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        #: Bytes of the largest machine: a task that asks for more would wait for ever.
        self._most = int(max((resources.get("memory", 0) for resources in nodes), default=0))

    def submit(self, job: Any) -> None:
        """Add the job to the queue as a task."""
        # Another machine has no such folder; it takes its own for temporary files.
        memory = min(job.memory, self._most)
        make = self._remote.options(memory=memory) if memory else self._remote
        self._running[make.remote(replace(job, work=None))] = job.id

    def next(self) -> Finished:
        """Wait for a task; a task whose worker or machine went away has no outcome."""
        assert self._running, "next() without a submitted job"
        done, _ = self._ray.wait(list(self._running), num_returns=1)
        key = self._running.pop(done[0])
        try:
            return Finished(key, self._ray.get(done[0]))
        except self._ray.exceptions.RayError as error:
            return Finished(key, None, f"the Ray worker was lost ({type(error).__name__})")

    def close(self) -> None:
        """Cancel what runs and leave the cluster; one that was started here ends."""
        for task in self._running:
            self._ray.cancel(task, force=True)
        self._running.clear()
        self._ray.shutdown()


def _import_ray() -> Any:
    try:
        import ray
    except ImportError as error:
        raise PluginUnavailable(f"--ray needs Ray: {install_extra('ray')}") from error
    return ray
