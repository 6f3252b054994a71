"""The list of checks: each registers itself with the kind of part it is for and the trait that calls for it.

Sources are functions that open recordings, so there is no part to check: what is checked is a ``SourceUnderTest``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from gsstream.core.errors import STRANGERS, SourceError
from gsstream.core.kinds import CONTRACTS, PART_KINDS
from gsstream.core.part import Part
from gsstream.input.recordings.base import Source

#: Kinds of part on which all common checks are made; on parts of other kinds only those of settings, freezing and
#: declaration are.
BEHAVED = tuple(name for name, kind in PART_KINDS.items() if kind.behaviour)

#: Characters of a reason why a check fails, at least: enough for a sentence, too many for "todo".
MIN_REASON = 20

CheckFunction = TypeVar("CheckFunction", bound=Callable[..., None])


class Advice(Exception):
    """Raised for a property that a part should have and works without: a warning, not a failure."""


@dataclass(frozen=True, slots=True)
class Check:
    """One property."""

    name: str  # name of the function; stable, because expected failures are given by it
    kind: str  # "common", a kind of part, "source", "method", "packet" or "command"
    kinds: tuple[str, ...]  # kinds of part that the check is made on
    trait: str | None  # only parts that claim this field of their ``Traits`` are checked; None: every part
    function: Callable[..., None]  # raises an AssertionError that states numbers

    @property
    def meaning(self) -> str:
        """First line of the function's docstring."""
        return (self.function.__doc__ or "").strip().splitlines()[0]


CHECKS: dict[str, Check] = {}


def check(kind: str, trait: str | None = None, kinds: tuple[str, ...] | None = None) -> Callable[..., Any]:
    """Register a function ``check_*(subject)`` of a kind, for parts that claim a ``trait`` (None: all).

    ``kinds``: kinds of part that the check is made on; None: only ``kind``.
    """

    def register(function: CheckFunction) -> CheckFunction:
        name = function.__name__
        assert name.startswith("check_") and name not in CHECKS, name
        CHECKS[name] = Check(name=name, kind=kind, kinds=kinds or (kind,), trait=trait, function=function)
        return function

    return register


def kind_of(part: Part | SourceUnderTest) -> str:
    """Return the kind whose abstract base class ``part`` implements. Raises TypeError when it is none of them."""
    if isinstance(part, SourceUnderTest):
        return "source"
    for kind in CONTRACTS:
        if isinstance(part, PART_KINDS[kind].contract_class()):
            return kind
    raise TypeError(f"expected a part of one of the kinds {', '.join(CONTRACTS)}, got {type(part).__name__}")


def checks_for(kind: str) -> list[Check]:
    """Return all checks made on a kind of part, common ones first."""
    return [entry for entry in CHECKS.values() if kind in entry.kinds]


def expected_failure_of(subject: object) -> dict[str, str]:
    """Return check -> reason of all checks that a part denies; empty for other subjects, and when the part raises."""
    if not isinstance(subject, Part):
        return {}
    try:
        return dict(subject.denials())
    except STRANGERS:  # a part may raise anything; ``check_denials`` reports it
        return {}


class Skip(Exception):
    """Raised by a check that cannot be made here; the message says why. Skips are reported and counted."""


class SourceUnderTest:
    """A part of the kind "source" and the recording that it is checked on.

    Arguments:
        target: called as ``target(uri, scale)``.
        uri: the recording; it is opened anew for every check. Keep it small: every check reads some of its frames.
        given: whether somebody asked for this recording. One that was only guessed and cannot be opened skips checks.
    """

    def __init__(self, target: Callable[[str, float], Source], uri: str, *, given: bool = True) -> None:
        self.target, self.uri, self.given = target, uri, given

    def __repr__(self) -> str:
        return f"source {getattr(self.target, '__name__', self.target)} on {self.uri!r}"

    @contextmanager
    def open(self, scale: float = 1.0) -> Iterator[Source]:
        """Open the recording; it is closed when the check is over."""
        try:
            source = self.target(self.uri, scale)
        except SourceError as error:
            if self.given or scale != 1.0:
                raise
            raise Skip(f"needs a recording, give one with --source ({error})") from error
        try:
            yield source
        finally:
            source.close()
