"""How much memory one piece of input may take: a limit that every door asks before it allocates.

A few bytes can announce millions of Gaussians or pixels. Whoever knows what they would take, before taking it, asks
:func:`require_memory`; what a person allows stands in the environment variable ``GSSTREAM_MAX_MEMORY`` ("500MB"), and
without one it is half of the machine's memory.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path

from gsstream.core.errors import InputError
from gsstream.core.quantity import BYTES, read_quantity

VARIABLE = "GSSTREAM_MAX_MEMORY"
#: Share of the machine's memory that may be used where nobody names a limit; and the bytes that a machine is taken to
#: have where the system does not tell.
SHARE, UNKNOWN = 0.5, 8_000_000_000
#: What a container may use.
_CGROUP = Path("/sys/fs/cgroup/memory.max")
_given: ContextVar[int | None] = ContextVar("given", default=None)


def memory_limit() -> int:
    """Return the bytes that one piece of input may take.

    The innermost :func:`limited_memory`, else ``GSSTREAM_MAX_MEMORY``, else half of the machine's memory. Raises
    InputError when the variable holds no positive size.
    """
    named = named_limit()
    return int(SHARE * _machine()) if named is None else named


def named_limit() -> int | None:
    """Return the limit that somebody named, as :func:`memory_limit` does; None where nobody did."""
    given = _given.get()
    if given is not None:
        return given
    text = os.environ.get(VARIABLE)
    if text is None:
        return None
    try:
        size = int(read_quantity(text, BYTES))
    except ValueError as error:
        raise InputError(f"the environment variable {VARIABLE}={text}: {error}") from error
    if size < 1:
        raise InputError(f"the environment variable {VARIABLE}={text}: expected a positive size, e.g. 500MB")
    return size


@contextmanager
def limited_memory(most: int | None) -> Iterator[None]:
    """Let what runs inside, in this thread, take at most ``most`` bytes; None: the limit stays as it is."""
    token = _given.set(_given.get() if most is None else most)
    try:
        yield
    finally:
        _given.reset(token)


def require_memory(wanted: float, what: str) -> None:
    """Raise InputError when ``what`` would take more bytes than :func:`memory_limit` allows; ask before taking them.

    ``what`` begins the sentence: "drawing 640 x 480 pixels", "the picture frames/000000.png".
    """
    limit = memory_limit()
    if wanted > limit:
        raise InputError(
            f"{what} takes about {megabytes(wanted)} MB; the limit is {megabytes(limit)} MB. Raise --max-memory, or "
            f"the environment variable {VARIABLE}, if you trust this input"
        )


def megabytes(size: float) -> str:
    """Return bytes as a number of MB to be read."""
    return f"{size / 1e6:,.0f}" if size >= 10_000_000 else f"{size / 1e6:.3g}"


@functools.cache
def _machine() -> int:
    """Bytes of memory that this machine, or this container, has."""
    known = []
    if "SC_PHYS_PAGES" in getattr(os, "sysconf_names", {}):
        known.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    with suppress(OSError, ValueError):  # not in a container, or in one without a limit ("max")
        known.append(int(_CGROUP.read_text(encoding="ascii")))
    return min((size for size in known if size > 0), default=UNKNOWN)
