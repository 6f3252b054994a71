"""What a plugin does to the standard streams while it is loaded, undone."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def kept_outputs() -> Iterator[list[str]]:
    """Open stdout and stderr again where what runs closed them; gives a list that then names these."""
    before = {name: kept for name in ("stdout", "stderr") if (kept := _copy(name)) is not None}
    closed: list[str] = []
    try:
        yield closed
    finally:
        closed += [name for name, kept in before.items() if _reopened(name, *kept)]


def _copy(name: str) -> tuple[int, int] | None:
    """Return the number of a stream and of a copy of it; None where it has none (captured, or closed already)."""
    try:
        number = getattr(sys, name).fileno()
        return number, os.dup(number)
    except (AttributeError, OSError, ValueError):
        return None


def _reopened(name: str, number: int, copy: int) -> bool:
    """Open a stream again that was closed; say whether it was."""
    try:
        try:
            os.fstat(number)
            if not getattr(sys, name).closed:
                return False
        except OSError:
            pass  # closed by its number
        os.dup2(copy, number)
        if getattr(sys, name).closed:
            encoding = getattr(sys, name).encoding
            setattr(sys, name, os.fdopen(number, "w", encoding=encoding, errors="backslashreplace", closefd=False))
        return True
    finally:
        os.close(copy)
