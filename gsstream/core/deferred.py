"""Checks of numbers on a GPU, read together: every single look makes the processor wait for the device.

A check of numbers in the processor's memory is made at once. One of numbers on a GPU is made at once, too, unless
:func:`deferred_checks` is entered: then all of them are read when it is left.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import reduce
from operator import and_
from typing import Any

#: Makes the error of a check that failed.
MakeError = Callable[[], Exception]
#: A tensor [] bool that must be true, and the error to raise where it is not.
Check = tuple[Any, MakeError]


@dataclass(slots=True)
class _Deferred:
    """What is read at the end of a context."""

    checks: list[Check]
    #: Watched thing -> a function that returns whether all is well with it, and one to call where it is not.
    watched: dict[object, tuple[Callable[[], Any], Callable[[], None]]]
    #: Makes the error of a check one that names the part that is being called.
    named: Callable[[MakeError], MakeError]


_DEFERRED: ContextVar[_Deferred | None] = ContextVar("deferred", default=None)


def require(ok: Any, error: MakeError) -> None:
    """Raise an error unless ``ok``, a tensor [] bool, holds: now, or for one on a GPU when deferred checks are read."""
    deferred = _DEFERRED.get()
    if deferred is not None and ok.device.type != "cpu":
        deferred.checks.append((ok, deferred.named(error)))
    elif not bool(ok):
        raise error()


def are_deferred() -> bool:
    """Say whether checks of numbers on a GPU are put off."""
    return _DEFERRED.get() is not None


def watch(what: object, holds: Callable[[], Any], act: Callable[[], None]) -> None:
    """Have ``act()`` called when deferred checks are read and ``holds()``, a tensor [] bool on a GPU, is not true.

    The same thing is watched once. Raises ValueError where checks are not deferred.
    """
    deferred = _DEFERRED.get()
    if deferred is None:
        raise ValueError("watch: expected to be within deferred_checks(), which calls what is watched")
    deferred.watched[what] = holds, act


@contextmanager
def collected_checks() -> Iterator[list[Check]]:
    """Within this context, checks of numbers on a GPU are put into the list and read by whoever asked for it."""
    outer = _DEFERRED.get()
    checks: list[Check] = []
    collected = _Deferred(checks, {}, _as_it_is) if outer is None else replace(outer, checks=checks)
    token = _DEFERRED.set(collected)
    try:
        yield checks
    finally:
        _DEFERRED.reset(token)


@contextmanager
def deferred_checks(enabled: bool = True) -> Iterator[None]:
    """Put off the checks of numbers on a GPU to the end of this context; with ``enabled`` false, none is put off.

    At the end, the error of the first failed check is raised, as the place of the check would have raised it. Results
    that were computed after this check are wrong, too, and must be given up.
    """
    deferred = _Deferred([], {}, _as_it_is)
    token = _DEFERRED.set(deferred if enabled else None)
    try:
        yield
    finally:
        _DEFERRED.reset(token)
    read = [ok for ok, _ in deferred.checks] + [holds() for holds, _ in deferred.watched.values()]
    if read and not bool(reduce(and_, read)):
        for holds, act in deferred.watched.values():
            if not bool(holds()):
                act()
        for ok, error in deferred.checks:
            if not bool(ok):
                raise error()


@contextmanager
def named_checks(named: Callable[[MakeError], MakeError]) -> Iterator[None]:
    """Within this context, ``named`` makes the errors of deferred checks, from those that say only what is wrong."""
    deferred = _DEFERRED.get()
    if deferred is None:
        yield
        return
    before, deferred.named = deferred.named, named
    try:
        yield
    finally:
        deferred.named = before


def _as_it_is(error: MakeError) -> MakeError:
    return error
