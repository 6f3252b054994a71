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

#: Function from an error that says what is wrong to the error that is raised, which also names the part at fault.
Blame = Callable[[Exception], Exception]
Check = tuple[Any, Callable[[], Exception], Blame]
_PENDING: ContextVar[list[Check] | None] = ContextVar("pending", default=None)
_WATCHED: ContextVar[dict[object, tuple[Callable[[], Any], Callable[[], None]]]] = ContextVar("watched")
_BLAME: ContextVar[Callable[[], Blame]] = ContextVar("blame", default=lambda: lambda error: error)


def require(ok: Any, error: Callable[[], Exception]) -> None:
    """Raise an error unless ``ok``, a tensor [] bool, holds: now, or for one on a GPU when deferred checks are read."""
    pending = _PENDING.get()
    if pending is not None and ok.device.type != "cpu":
        pending.append((ok, error, _BLAME.get()()))
    elif not bool(ok):
        raise error()


def are_deferred() -> bool:
    """Say whether checks of numbers on a GPU are put off."""
    return _PENDING.get() is not None


def watch(what: object, holds: Callable[[], Any], act: Callable[[], None]) -> None:
    """Have ``act()`` called when deferred checks are read and ``holds()``, a tensor [] bool on a GPU, is not true.

    The same thing is watched once; checks must be deferred.
    """
    _WATCHED.get()[what] = holds, act


@contextmanager
def collected_checks() -> Iterator[list[Check]]:
    """Within this context, checks of numbers on a GPU are put into the list and read by whoever asked for it."""
    checks: list[Check] = []
    token = _PENDING.set(checks)
    try:
        yield checks
    finally:
        _PENDING.reset(token)


@contextmanager
def deferred_checks(enabled: bool = True) -> Iterator[None]:
    """Put off the checks of numbers on a GPU to the end of this context; with ``enabled`` false, none is put off.

    At the end, the error of the first failed check is raised, as the place of the check would have raised it. Results
    that were computed after this check are wrong, too, and must be given up.
    """
    pending: list[Check] = []
    watched: dict[object, tuple[Callable[[], Any], Callable[[], None]]] = {}
    token, other = _PENDING.set(pending if enabled else None), _WATCHED.set(watched)
    try:
        yield
    finally:
        _PENDING.reset(token)
        _WATCHED.reset(other)
    read = [ok for ok, *_ in pending] + [holds() for holds, _ in watched.values()]
    if read and not bool(reduce(and_, read)):
        for holds, act in watched.values():
            if not bool(holds()):
                act()
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
