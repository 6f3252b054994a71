"""A source as the subject of checks: sources are functions that open recordings, so there is no part to check."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from gsstream.core.errors import SourceError
from gsstream.input.recordings.base import Source


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
