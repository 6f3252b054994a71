"""Threads for many small tensors, on several processors."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import torch

from gsstream.core.processors import processors

#: More threads than this wait for each other between their small operations: sixteen of them take three times as long.
MOST = 4


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch run on one thread: a second one within a small operation costs more time than it saves."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def one_thread_each(workers: int = 0) -> Iterator[ThreadPoolExecutor]:
    """Give a pool of threads, and let torch run on one thread inside and outside of it.

    0 workers: one for each processor, at most MOST.
    """
    number = workers or min(processors(), MOST)
    with one_thread(), ThreadPoolExecutor(number, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        yield pool
