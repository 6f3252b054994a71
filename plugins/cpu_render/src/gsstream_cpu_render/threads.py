"""Threads and instruction set of the native kernels."""

from __future__ import annotations

from gsstream_cpu_render import _native
from gsstream_cpu_render.arrays import refuse_value


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


def instruction_set() -> str:
    """Return the instruction set in use: avx512, avx2, baseline or neon.

    Default: environment variable GSSTREAM_ISA, else the strongest that this processor has.
    Raises InputError if GSSTREAM_ISA names one that it lacks.
    """
    try:
        return str(_native.active_isa())
    except ValueError as error:
        refuse_value(str(error))
