"""What a command shows while it works, and how it ends when it is told to."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import typer

from gsstream.core.progress import ProgressDisplay


@contextmanager
def working(what: str, quiet: bool = False) -> Iterator[ProgressDisplay]:
    """Show what is worked at; Ctrl-C, SIGTERM and SIGHUP end it at once, and temporary files go."""
    from gsstream.engine.run.output import ended_by_signals

    with ended_by_signals() as came, ProgressDisplay(quiet) as display:
        display.tell(what)
        try:
            yield display
        except KeyboardInterrupt:
            raise typer.Exit(128 + came[0] if came else 130) from None
