"""Checks of numbers on a GPU, read together: every single look makes the processor wait for the device.

A check of numbers in the processor's memory is made at once. One of numbers on a GPU is made at once, too, unless
:func:`deferred_checks` is entered: then all of them are read when it is left.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import reduce
from operator import and_
from typing import Any

#: Makes an error, which says what is wrong, into the one that is raised, which also says whose fault it is.
Blame = Callable[[Exception], Exception]
_PENDING: ContextVar[list[tuple[Any, Callable[[], Exception], Blame]] | None] = ContextVar("pending", default=None)
_BLAME: ContextVar[Callable[[], Blame]] = ContextVar("blame", default=lambda: lambda error: error)


def require(ok: Any, error: Callable[[], Exception]) -> None:
    """Raise an error unless ``ok``, a tensor [] bool, holds: now, or for one on a GPU when deferred checks are read."""
    pending = _PENDING.get()
    if pending is not None and ok.device.type != "cpu":
        pending.append((ok, error, _BLAME.get()()))
    elif not bool(ok):
        raise error()


@contextmanager
def deferred_checks(enabled: bool = True) -> Iterator[None]:
    """Put off the checks of numbers on a GPU to the end of this context; with ``enabled`` false, none is put off.

    At the end, the error of the first failed check is raised, as the place of the check would have raised it. Results
    that were computed after this check are wrong, too, and must be given up.
    """
    pending: list[tuple[Any, Callable[[], Exception], Blame]] = []
    token = _PENDING.set(pending if enabled else None)
    try:
        yield
    finally:
        _PENDING.reset(token)
    if pending and not bool(reduce(and_, (ok for ok, *_ in pending))):
        for ok, error, blame in pending:
            if not bool(ok):
                found = error()
                raise blame(found) from found


@contextmanager
def blaming(blame: Callable[[], Blame]) -> Iterator[None]:
    """Within this context, errors of deferred checks pass through the function that ``blame()`` returns."""
    token = _BLAME.set(blame)
    try:
        yield
    finally:
        _BLAME.reset(token)
