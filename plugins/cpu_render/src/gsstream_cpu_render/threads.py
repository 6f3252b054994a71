"""Threads of the native kernels, and what this machine can do at most."""

from __future__ import annotations

from gsstream_cpu_render import _native
from gsstream_cpu_render.checks import refuse_value


def num_threads() -> int:
    """Threads that work on one call, the caller included.

    Default: environment variable GSSTREAM_THREADS, else the processors this process may use.
    Raises InputError if GSSTREAM_THREADS is no integer from 1 to 1024.
    """
    try:
        return int(_native.num_threads())
    except ValueError as error:
        refuse_value(str(error))


def set_num_threads(n: int) -> None:
    """Set the number of threads, 1 to 1024. Results do not depend on it, bit for bit. Raises InputError."""
    if isinstance(n, bool) or not isinstance(n, int) or not 1 <= n <= 1024:
        refuse_value(f"set_num_threads: expected an integer from 1 to 1024, got {n!r}")
    _native.set_num_threads(n)


def fma_peak(threads: int = 1, seconds: float = 0.2) -> float:
    """Measure 10^9 float32 operations per second (a multiply-add is two) in registers, over ``seconds`` in (0, 60]."""
    try:
        return float(_native.fma_peak(threads, seconds))
    except ValueError as error:
        refuse_value(str(error))


def copy_peak(threads: int = 1, megabytes: float = 64.0) -> float:
    """Measure 10^9 bytes per second, read plus written, copying ``megabytes`` (0.001 to 4096) a thread."""
    try:
        return float(_native.copy_peak(threads, megabytes))
    except ValueError as error:
        refuse_value(str(error))
