"""Torch on one thread while frames are encoded."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Run what is inside with one thread of torch, and restore the number afterwards.

    Torch's share of a frame is elementwise work on few rows: more threads cost more than they give, and spin against
    the native kernels' own pool. One thread also keeps its sums, and so the bytes, independent of the machine's cores.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
