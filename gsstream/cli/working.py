"""Progress of a command on the terminal, and its end by a signal."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import typer

from gsstream.core.progress import ProgressDisplay


@contextmanager
def working(what: str, quiet: bool = False) -> Iterator[ProgressDisplay]:
    """Show the work of a command; Ctrl-C, SIGTERM and SIGHUP end the command at once and remove its temporary files."""
    from gsstream.engine.run.output import ended_by_signals
    from gsstream.store.fetch import told_to

    with ended_by_signals() as came, ProgressDisplay(quiet) as display, told_to(display.tell):
        display.tell(what)
        try:
            yield display
        except KeyboardInterrupt:
            raise typer.Exit(128 + came[0] if came else 130) from None
