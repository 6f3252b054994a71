"""The pool of idle rasterisers: a lease may be collected at any moment, also while the pool is at work."""

from __future__ import annotations

import subprocess
import sys
import threading
from typing import Any

import numpy as np
import pytest
from gsstream_cpu_render import pool

from gsstream.core.cameras import Cameras

K = np.array([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]])
RIG = Cameras(("one",), np.eye(4)[None], K[None], 16, 16)


def test_a_lease_that_is_collected_while_the_pool_is_at_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """The finaliser once waited for the lock that its own thread held: the encoder stood still for ever."""
    held = [pool.acquire_rasterizer(RIG, 0, (0.0, 0.0, 0.0)) for _ in range(2)]
    held.pop()  # one idle rasteriser, so that the pool has something to look through
    isa = pool._native.active_isa

    class Collecting:
        """Drops the last reference to a lease where the pool allocates, as the collector may."""

        def active_isa(self) -> Any:
            held.clear()
            return isa()

    monkeypatch.setattr(pool, "_native", Collecting())
    made: list[Any] = []
    worker = threading.Thread(target=lambda: made.append(pool.acquire_rasterizer(RIG, 0, (0.0, 0.0, 0.0))), daemon=True)
    worker.start()
    worker.join(30)
    assert made, "the pool waits for itself"
    assert held == []


def test_a_lease_that_outlives_its_module_is_dropped_without_a_word() -> None:
    """Python takes a module's names away at its end; the finaliser of before then raised a TypeError to stderr."""
    program = """
import numpy as np
from gsstream.core.cameras import Cameras
from gsstream_cpu_render import pool
rig = Cameras(("one",), np.eye(4)[None], np.array([[[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]]), 16, 16)
held = pool.acquire_rasterizer(rig, 0, (0.0, 0.0, 0.0))
pool._lock = None
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert (ended.returncode, ended.stderr) == (0, "")
